"""Building NanoVDB grids of floats or int32 on the device where their leaves are; only the head is made on the host."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit import _launch
from geokit.volume._grid_head import GridHead, Places, places_of, write_head, write_root
from geokit.volume._nanovdb import HEAD_SIZE, aligned_buffer
from geokit.volume._nanovdb_checksum import partial_checksum
from geokit.volume._tiles import counted

if TYPE_CHECKING:
    import warp as wp

__all__ = ["BuiltGrid", "Leaves", "build_grid"]

# Logarithms of the slots along an axis of a lower and of an upper node, and voxels along an axis.
LOWER_BITS, LOWER_SPAN = 4, 128
UPPER_BITS, UPPER_SPAN = 5, 4096


@dataclass(frozen=True)
class Leaves:
    """Where the leaves of a grid are, in the order of its nodes.

    Attributes:
        keys: Place of each leaf in that order, ascending, each once, (L,) of int64; see ``_tiles_kernels``.
        tiles: Coordinates in units of leaves, any number of them in any order, (T,) of vec3i.
        rows: Row of each leaf among the tiles, (L,) of int32.
        axes: Coordinates of upper nodes along x, y and z, in units of themselves, in the order of their ranks in keys.
    """

    keys: "wp.array"
    tiles: "wp.array"
    rows: "wp.array"
    axes: tuple[NDArray[np.int64], ...]


@dataclass(frozen=True)
class BuiltGrid:
    """A grid on a device, and its first bytes (headers, root and root's table) on the host.

    On the CPU ``host`` is the grid itself and ``buffer`` shares its memory.
    """

    buffer: "wp.array"
    head: NDArray[np.uint8]
    host: NDArray[np.uint8] | None


@dataclass(frozen=True)
class _Level:
    """Nodes of one kind: key and first child of each (one more entry ends the last), and the parent of each child."""

    keys: "wp.array"
    first_child: "wp.array"
    parent: "wp.array"
    count: int


def build_grid(
    leaves: Leaves,
    head: GridHead,
    write_leaves: Callable[["wp.array", int], None],
    inside: "wp.array | None" = None,
    *,
    seal: bool = True,
) -> BuiltGrid:
    """A grid from leaves whose values a function writes.

    Args:
        leaves: Where they are.
        head: What the grid is to be.
        write_leaves: Called with the buffer and the byte where the leaves begin; writes 512 values from byte 96 of each
            leaf on, 2144 bytes apart, and the mask of its active voxels from byte 16 on.
        inside: Bits of the voxels that lie inside, (L, 8) of uint64: empty regions next to such voxels take
            ``head.inside`` instead of the background.
        seal: Write the checksum of headers and root.
    Raises:
        InputError: The leaves are too far apart.
    """
    device = leaves.keys.device
    count = len(leaves.keys)
    lower = _parents(leaves.keys, 3 * LOWER_BITS)
    upper = _parents(lower.keys, 3 * UPPER_BITS)
    ranks = upper.keys.numpy()[: upper.count]
    uppers = np.stack(
        [axis[ranks >> shift & 0xFFF] for axis, shift in zip(leaves.axes, (24, 12, 0), strict=True)], axis=1
    )
    places = places_of(head.layout, count, lower.count, uppers, fill_gaps=inside is not None)
    buffer, host = _buffer(places.size, device)
    states, faces = _spread_signs(inside, leaves, lower, upper)
    _link(buffer, head, places, (leaves, lower, upper), states)
    write_leaves(buffer, places.leaf_begin)
    boxes, extrema, active = _statistics(buffer, head, places, leaves, lower, upper)
    start = write_head(head, places, faces)
    write_root(start, head, boxes, extrema, active)
    if seal:
        start[8:16].view("<u8")[0] = partial_checksum(start[:HEAD_SIZE], start)
    _put(buffer, host, start)
    return BuiltGrid(buffer, start, host)


def _buffer(size: int, device: "wp.Device") -> tuple["wp.array", NDArray[np.uint8] | None]:
    import warp as wp

    if device.is_cuda:
        # Zeros also where nothing is written: the same leaves give the same bytes.
        return wp.zeros(size, dtype=wp.uint8, device=device), None
    # calloc's pages are zero until they are written: padding costs nothing and the leaves are touched once.
    host = aligned_buffer(size, zeroed=True)
    array: Any = wp.array(host, dtype=wp.uint8, device=device, copy=False)
    return array, host


def _put(buffer: "wp.array", host: NDArray[np.uint8] | None, start: NDArray[np.uint8]) -> None:
    import warp as wp

    if host is not None:
        host[: len(start)] = start
    else:
        wp.copy(buffer, wp.array(start, dtype=wp.uint8, device="cpu", copy=False), count=len(start))


def _parents(keys: "wp.array", bits: int) -> _Level:
    import warp as wp

    from geokit.volume._device_build_kernels import parents_kernel, starts_kernel

    count, device = len(keys), keys.device
    starts = wp.empty(count, dtype=wp.int32, device=device)
    _launch.launch(starts_kernel, count, [keys, bits], [starts], device)
    ends, total = counted(starts)
    parents = wp.empty(total, dtype=wp.int64, device=device)
    first_child = wp.zeros(total + 1, dtype=wp.int32, device=device)
    _launch.launch(parents_kernel, count, [keys, bits, starts, ends], [parents, first_child], device)
    return _Level(parents, first_child, ends, total)


def _spread_signs(
    inside: "wp.array | None", leaves: Leaves, lower: _Level, upper: _Level
) -> tuple[list["wp.array | None"], NDArray[np.uint8]]:
    """States of the slots of lower and upper nodes, and the faces of the upper ones.

    A narrow band keeps every sign change inside its leaves: a slot without child lies on one side, the one that the
    touching face of any neighbour shows. One sweep each along z, y and x reaches every slot of a node with a child.
    """
    import warp as wp

    from geokit.volume import _node_signs_kernels as kernels

    if inside is None:
        return [None, None], np.zeros(upper.count, np.uint8)
    device = inside.device
    faces = wp.empty(len(leaves.keys), dtype=wp.uint8, device=device)
    _launch.launch(kernels.leaf_faces_kernel, len(faces), [inside], [faces], device)
    states: list[wp.array | None] = []
    for keys, level, bits in ((leaves.keys, lower, LOWER_BITS), (lower.keys, upper, UPPER_BITS)):
        state = wp.zeros(level.count << (3 * bits), dtype=wp.uint8, device=device)
        inputs = [keys, 3 * bits, level.parent, faces]
        _launch.launch(kernels.place_children_kernel, len(keys), inputs, [state], device)
        for axis in (2, 1, 0):
            _launch.launch(kernels.sweep_kernel, level.count << (2 * bits), [bits, axis], [state], device)
        faces = wp.empty(level.count, dtype=wp.uint8, device=device)
        _launch.launch(kernels.node_faces_kernel, level.count, [bits, state], [faces], device)
        states.append(state)
    return states, faces.numpy()


def _link(
    buffer: "wp.array",
    head: GridHead,
    places: Places,
    levels: tuple[Leaves, _Level, _Level],
    states: list["wp.array | None"],
) -> None:
    import warp as wp

    from geokit.volume._device_build_kernels import link_kernel

    leaves, lower, upper = levels
    layout, device = head.layout, buffer.device
    outside, inside = (wp.uint64(_word_of(value, head.word)) for value in (head.background, head.inside))
    for children, nodes, bits, state, begin, size, table, child_begin, child_size in (
        (lower.keys, upper, UPPER_BITS, states[1], places.upper_begin, layout.upper_size, layout.upper_table,
         places.lower_begin, layout.lower_size),
        (leaves.keys, lower, LOWER_BITS, states[0], places.lower_begin, layout.lower_size, layout.lower_table,
         places.leaf_begin, layout.leaf_size),
    ):  # fmt: skip
        given = wp.empty(0, dtype=wp.uint8, device=device) if state is None else state
        numbers = [wp.int64(n) for n in (begin, size, table, child_begin, child_size)]
        inputs = [3 * bits, nodes.keys, nodes.first_child, children, *numbers, given, outside, inside]
        _launch.launch(link_kernel, nodes.count << (3 * bits - 6), inputs, [buffer], device, grain=64)


def _word_of(value: float, kind: np.dtype[Any]) -> int:
    """The bits of a tile's value in its slot of eight bytes."""
    return int(np.array([value], kind).view("<u4")[0])


def _statistics(
    buffer: "wp.array", head: GridHead, places: Places, leaves: Leaves, lower: _Level, upper: _Level
) -> tuple[NDArray[np.int32], NDArray[Any], int]:
    """Boxes and extrema of all nodes, written into them; those of the upper ones, and the number of active voxels."""
    import warp as wp

    from geokit.volume import _device_build_kernels as kernels

    device, layout = buffer.device, head.layout
    of_leaf, of_node = (
        (kernels.float_leaf_kernel, kernels.float_node_kernel)
        if layout.name == "float"
        else (kernels.int_leaf_kernel, kernels.int_node_kernel)
    )

    def room(count: int) -> list["wp.array"]:
        return [wp.empty(n * count, dtype=wp.int32, device=device) for n in (6, 2)]

    count = len(leaves.keys)
    active = wp.empty(count, dtype=wp.int32, device=device)
    where = [leaves.tiles, leaves.rows]
    found = room(count)
    begin = wp.int64(places.leaf_begin)
    _launch.launch(of_leaf, count, [begin, *where], [buffer, *found, active], device, grain=64)
    first_leaf = wp.empty(upper.count, dtype=wp.int32, device=device)
    _launch.launch(kernels.first_leaf_kernel, upper.count, [upper.first_child, lower.first_child], [first_leaf], device)
    for nodes, first, span, begin_at, size, bits in (
        (lower, lower.first_child, LOWER_SPAN, places.lower_begin, layout.lower_size, LOWER_BITS),
        (upper, first_leaf, UPPER_SPAN, places.upper_begin, layout.upper_size, UPPER_BITS),
    ):
        statistics = 32 + 2 * (1 << (3 * bits)) // 8
        numbers = [span, wp.int64(begin_at), wp.int64(size), wp.int64(statistics)]
        inputs = [*numbers, nodes.first_child, first, *found, *where]
        found = room(nodes.count)
        _launch.launch(of_node, nodes.count, inputs, [buffer, *found], device, grain=1)
    boxes, extrema = found[0].numpy().reshape(-1, 2, 3), found[1].numpy().view(head.word).reshape(-1, 2)
    return boxes, extrema, counted(active)[1]
