"""Writer of NanoVDB grids of floats or int32, on the device that holds their leaves; the host writes only the head."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory.device_arena import Scratch, ScratchArray
from geokit.core.memory.host_array import HostArray
from geokit.core.memory.pinned import PinnedArray, host_arrays
from geokit.core.scan import prefix_sum_async
from geokit.volume.nanovdb.checksum import partial_checksum
from geokit.volume.nanovdb.grid_array import array_of, empty_grid
from geokit.volume.nanovdb.header import HEAD_SIZE, aligned_buffer, grid_header
from geokit.volume.nanovdb.layout import GridLayout
from geokit.volume.tree.flood_signs import spread_signs
from geokit.volume.tree.grid_head import GridHead, Places, places_of, write_head, write_root

# Logarithms of the slots along an axis of a lower and of an upper node, and voxels along an axis.
LOWER_BITS, LOWER_SPAN = 4, 128
UPPER_BITS, UPPER_SPAN = 5, 4096
# Upper nodes whose keys reach the host without a separate copy: each spans 4096^3 voxels.
FEW_UPPERS = 256
# Parts of a lower node's children that GPU threads reduce in parallel; a CPU reduces all in one loop.
PARTS_CPU, PARTS_CUDA = 0, 64


@dataclass(frozen=True)
class Leaves:
    """Positions of the leaves of a grid, in breadth-first order.

    Attributes:
        keys: Key of each leaf in that order, ascending and unique, (L,) of int64; see ``tiles_kernels``.
        tiles: Coordinates in units of leaves, any number of them in any order, (T,) of vec3i.
        rows: Row of each leaf among the tiles, (L,) of int32.
        axes: Coordinates of upper nodes in units of upper nodes, in the order of their ranks in the keys: either three
            arrays, along x, y and z, each addressed by 12 bits of a key, or one (U, 3) addressed by all 36 bits.
    """

    keys: "wp.array | HostArray"
    tiles: "wp.array"
    rows: "wp.array | HostArray"
    axes: tuple[NDArray[np.int64], ...] | NDArray[np.int64]

    @cached_property
    def nodes(self) -> _Nodes:
        """The nodes above the leaves; read early, they are ready when the grid is built."""
        return _Nodes(self.keys)

    def upper_places(self, ranks: NDArray[np.int64]) -> NDArray[np.int64]:
        """Coordinates (U, 3) of upper nodes by their ranks."""
        if isinstance(self.axes, tuple):
            parts = zip(self.axes, (24, 12, 0), strict=True)
            return np.stack([axis[ranks >> shift & 0xFFF] for axis, shift in parts], axis=1)
        return self.axes[ranks]


@dataclass(frozen=True)
class BuiltGrid:
    """A grid on a device, with a copy of its first bytes (headers, root and root table) on the host.

    On the CPU ``host`` is the grid itself and ``buffer`` shares its memory. Of a grid of more than 2^31 - 1 bytes,
    ``buffer`` shows the first of these.
    """

    buffer: "wp.array"
    head: NDArray[np.uint8]
    host: NDArray[np.uint8] | None

    @property
    def size(self) -> int:
        """Bytes of the grid."""
        return int(grid_header(self.head)["grid_size"])


@dataclass(frozen=True)
class _Level:
    """Nodes of one level; there are ``count`` of them, and arrays may be longer.

    Attributes:
        keys: Key of each node.
        first_child: First child of each node; one more entry ends the last.
        first_leaf: First leaf of each node.
        parent: For each child, the number of nodes up to its own.
    """

    keys: ScratchArray
    first_child: ScratchArray
    first_leaf: ScratchArray
    parent: ScratchArray
    count: int


def build_on_device(
    leaves: Leaves,
    head: GridHead,
    write_leaves: Callable[["wp.array", int], None],
    inside: "wp.array | None" = None,
) -> BuiltGrid:
    """Build a grid from leaves whose values are written by a function.

    Args:
        leaves: Positions of the leaves.
        head: Headers and options of the grid.
        write_leaves: Called with the buffer and the offset of the leaves. Writes 512 values from byte 96 of each leaf
            on, 2144 bytes apart, and the mask of its active voxels from byte 16 on.
        inside: Bits of the voxels that lie inside, (L, 8) of uint64: empty regions next to such voxels take
            ``head.inside`` instead of the background.
    Raises:
        InputError: The leaves are too far apart.
    """
    device = leaves.keys.device
    count = len(leaves.keys)
    lower, upper, ranks = leaves.nodes.read()
    places = places_of(head.layout, count, lower.count, leaves.upper_places(ranks), fill_gaps=inside is not None)
    buffer, host = _buffer(places.size, device)
    states, faces = _spread_signs(inside, leaves, lower, upper)
    layouts = _level_layouts(head.layout, places)
    _link(buffer, head, layouts, (leaves, lower, upper), states)
    write_leaves(buffer, places.leaf_begin)
    boxes, extrema, active = _statistics(buffer, head, places, layouts, leaves, lower, upper)
    # Nothing has waited for the device so far, and most grids need no wait before the head is written.
    start = write_head(head, places, faces.numpy() if places.gaps else np.zeros(upper.count, np.uint8))
    write_root(start, head, boxes.numpy().reshape(-1, 2, 3), extrema.numpy().view(head.word).reshape(-1, 2), active())
    start[8:16].view("<u8")[0] = partial_checksum(start[:HEAD_SIZE], start)
    _put(buffer, host, start)
    return BuiltGrid(buffer, start, host)


def _buffer(size: int, device: "wp.Device") -> tuple["wp.array", NDArray[np.uint8] | None]:
    if device.is_cuda:
        # Unwritten bytes are zero too, so that the same leaves give the same bytes.
        return empty_grid(size, device), None
    # Pages from calloc are zero until they are written: padding costs nothing and the leaves are touched once.
    host = aligned_buffer(size, zeroed=True)
    return array_of(host), host


def _put(buffer: "wp.array", host: NDArray[np.uint8] | None, start: NDArray[np.uint8]) -> None:
    if host is not None:
        host[: len(start)] = start
    else:
        wp.copy(buffer, wp.array(start, dtype=wp.uint8, device="cpu", copy=False), count=len(start))


class _Nodes:
    """Lower and upper nodes under construction."""

    def __init__(self, keys: "wp.array") -> None:
        from geokit.volume.tree import device_writer_kernels as kernels

        count, device = len(keys), keys.device
        shifts = [3 * LOWER_BITS, 3 * (LOWER_BITS + UPPER_BITS)]
        # There are at most as many nodes of either kind as leaves; the exact numbers are read once both are made.
        shapes = [*[((count,), wp.int32)] * 6, *[((count + 1,), wp.int32)] * 2, *[((count,), wp.int64)] * 2]
        arrays = Scratch(device, *shapes).arrays
        starts, ends, (upper_of, first_leaf), (lower_first, upper_first), (lower_keys, upper_keys) = (
            arrays[k : k + 2] for k in range(0, 10, 2)
        )
        launcher.launch(kernels.starts_kernel, count, [keys, *shifts], starts, device)
        if count:
            for some, sums in zip(starts, ends, strict=True):
                wp.utils.array_scan(some.warp, sums.warp, inclusive=True)
        self._few, self._counts = host_arrays(device, ((FEW_UPPERS,), np.int64), ((2,), np.int32))
        self._counts.values.fill(0)
        inputs = [keys, *shifts, starts[0], ends[0], starts[1], ends[1]]
        outputs = [lower_keys, lower_first, upper_of, upper_keys, upper_first, first_leaf, self._few, self._counts]
        launcher.launch(kernels.nodes_kernel, count, inputs, outputs, device)
        if isinstance(self._few, PinnedArray):
            self._few.pinned.close()
        self._lower = lower_keys, lower_first, lower_first, ends[0]
        self._upper = upper_keys, upper_first, first_leaf, upper_of

    def read(self) -> tuple[_Level, _Level, NDArray[np.int64]]:
        """Lower nodes, upper nodes, and the keys of the upper nodes on the host."""
        lower_count, upper_count = self._counts.numpy().tolist()
        keys = self._few if upper_count <= FEW_UPPERS else self._upper[0]
        lower, upper = _Level(*self._lower, lower_count), _Level(*self._upper, upper_count)
        return lower, upper, keys.numpy()[:upper_count]


def _spread_signs(
    inside: "wp.array | None", leaves: Leaves, lower: _Level, upper: _Level
) -> tuple[list[ScratchArray | None], Any]:
    """States of the slots of lower and upper nodes, and the faces of the upper nodes, for the host to read."""
    from geokit.volume.tree.node_signs_kernels import leaf_faces_kernel

    if inside is None:
        return [None, None], HostArray(np.zeros(upper.count, np.uint8))
    device = inside.device
    count = len(leaves.keys)
    faces, of_lower = Scratch(device, ((count,), wp.uint8), ((lower.count,), wp.uint8)).arrays
    slots = (lower.count << (3 * LOWER_BITS), upper.count << (3 * UPPER_BITS))
    states: list[ScratchArray | None] = [*Scratch(device, *(((n,), wp.uint8) for n in slots), zeroed=True).arrays]
    launcher.launch(leaf_faces_kernel, count, [inside], [faces], device)
    (of_upper,) = host_arrays(device, ((upper.count,), np.uint8))
    spread_signs(LOWER_BITS, leaves.keys, lower.parent, faces, states[0], of_lower, device)
    spread_signs(UPPER_BITS, lower.keys, upper.parent, of_lower, states[1], of_upper, device)
    return states, of_upper


def _level_layouts(layout: GridLayout, places: Places) -> tuple[Any, Any]:
    """The kernels' structs of the lower and of the upper nodes."""
    from geokit.volume.tree.device_writer_kernels import LevelLayout

    lower, upper = LevelLayout(), LevelLayout()
    for level, bits, span, begin, size, table, child_begin, child_size in (
        (lower, LOWER_BITS, LOWER_SPAN, places.lower_begin, layout.lower_size, layout.lower_table,
         places.leaf_begin, layout.leaf_size),
        (upper, UPPER_BITS, UPPER_SPAN, places.upper_begin, layout.upper_size, layout.upper_table,
         places.lower_begin, layout.lower_size),
    ):  # fmt: skip
        level.bits, level.span, level.begin, level.size, level.table = 3 * bits, span, begin, size, table
        level.statistics = 32 + 2 * (1 << level.bits) // 8
        level.child_begin, level.child_size = child_begin, child_size
    return lower, upper


def _link(
    buffer: "wp.array",
    head: GridHead,
    layouts: tuple[Any, Any],
    levels: tuple[Leaves, _Level, _Level],
    states: list[ScratchArray | None],
) -> None:
    from geokit.volume.tree.device_writer_kernels import link_kernel

    leaves, lower, upper = levels
    device = buffer.device
    # The bits of both tiles' values in their slots of eight bytes.
    outside, inside = map(wp.uint64, np.array([head.background, head.inside], head.word).view("<u4"))
    for children, nodes, level, state in (
        (lower.keys, upper, layouts[1], states[1]),
        (leaves.keys, lower, layouts[0], states[0]),
    ):
        given = wp.empty(0, dtype=wp.uint8, device=device) if state is None else state
        inputs = [level, nodes.keys, nodes.first_child, children, given, outside, inside]
        launcher.launch(link_kernel, nodes.count << (level.bits - 6), inputs, [buffer], device, grain=64)


def _statistics(
    buffer: "wp.array",
    head: GridHead,
    places: Places,
    layouts: tuple[Any, Any],
    leaves: Leaves,
    lower: _Level,
    upper: _Level,
) -> tuple[Any, Any, Callable[[], int]]:
    """Write boxes and extrema of all nodes.

    Returns those of the upper nodes, and the number of active voxels, for the host to read.
    """
    from geokit.volume.tree.device_writer_kernels import KERNELS

    device = buffer.device
    dtype = wp.float32 if head.layout.name == "float" else wp.int32
    of_leaf, of_part, of_node = KERNELS[dtype]
    count = len(leaves.keys)
    # There are few lower nodes, with hundreds of children each.
    lower_parts = PARTS_CUDA if device.is_cuda else PARTS_CPU
    # Boxes and extrema of leaves, parts and lower nodes.
    items = (count, lower_parts * lower.count, lower.count)
    shapes = [((n * k,), kind) for k in items for n, kind in ((6, wp.int32), (2, dtype))]
    active, *arrays = Scratch(device, ((count,), wp.int32), *shapes).arrays
    of_leaves, of_parts, of_lowers = arrays[:2], arrays[2:4], arrays[4:]
    of_uppers = host_arrays(device, ((6 * upper.count,), np.int32), ((2 * upper.count,), wp.dtype_to_numpy(dtype)))
    where = [leaves.tiles, leaves.rows]
    found: list[Any] = of_leaves
    begin = wp.int64(places.leaf_begin)
    launcher.launch(of_leaf, count, [begin, *where], [buffer, *found, active], device, grain=64)
    for level, layout, parts, of_nodes in (
        (lower, layouts[0], lower_parts, of_lowers),
        (upper, layouts[1], 0, of_uppers),
    ):
        if parts:
            inputs, found = [parts, level.first_child, *found], of_parts
            launcher.launch(of_part, parts * level.count, inputs, found, device)
        inputs = [layout, parts, level.first_child, level.first_leaf, *found, *where]
        found = of_nodes
        launcher.launch(of_node, level.count, inputs, [buffer, *found], device, grain=1)
    boxes, extrema = of_uppers
    return boxes, extrema, prefix_sum_async(active.warp)[1]
