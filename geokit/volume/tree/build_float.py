"""Building NanoVDB float grids from leaves: nodes placed breadth first, values written once and in place."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from geokit.core.launcher import thread_count
from geokit.errors import InputError
from geokit.volume.nanovdb.checksum import full_checksum, partial_checksum
from geokit.volume.nanovdb.header import FLAG_HAS_BBOX, HEAD_SIZE, aligned_buffer, grid_header, tree_header
from geokit.volume.nanovdb.header_options import checked_options, write_header
from geokit.volume.nanovdb.layout import LEAF_VOXELS, GridLayout, layout_of
from geokit.volume.nanovdb.types import FLOAT
from geokit.volume.tree.flood_signs import face_signs, flood
from geokit.volume.tree.node_places import LOWER, UPPER, Topology, link_nodes, root_span, topology_of

__all__ = ["NO_BOX", "FloatGridLayout", "allocate_float_grid", "build_float_grid", "finish", "local_boxes"]

# Leaves that a thread works on at a time: 256 of them are half a megabyte of values, which stays in the cache.
LEAVES_AT_A_TIME = 256
# A box that adds nothing to the union with another.
NO_BOX = np.array([[[np.iinfo(np.int32).max] * 3, [np.iinfo(np.int32).min] * 3]], np.int32)
_BITS = np.array([bin(i).count("1") for i in range(256)], np.uint8)
_FIRST_BIT = np.array([8] + [(i & -i).bit_length() - 1 for i in range(1, 256)], np.int8)
_LAST_BIT = np.array([i.bit_length() - 1 for i in range(256)], np.int8)


@dataclass(frozen=True)
class FloatGridLayout:
    """A float grid whose nodes have their places and whose values and masks are to be filled in.

    Attributes:
        buffer: The grid, uint8, 32-byte aligned; complete once :func:`finish` has run.
        leaf_origins: First voxel of each leaf in the grid's own order, shape (L, 3) int32.
        order: Rows of the origins given to :func:`allocate_float_grid` in the grid's order, shape (L,):
            ``leaf_origins == given[order]``.
        values: Values of each leaf in the grid's order, shape (L, 512) float32, z fastest, writable; rows are 2144
            bytes apart.
        masks: Active voxels of each leaf, shape (L, 64) uint8, writable: bit z of byte ``8 x + y``.
    """

    buffer: NDArray[np.uint8]
    leaf_origins: NDArray[np.int32]
    order: NDArray[np.int64]
    values: NDArray[np.float32]
    masks: NDArray[np.uint8]
    _topology: Topology
    _background: float


def build_float_grid(
    leaf_origins: NDArray[np.int32],
    leaf_values: NDArray[np.float32],
    leaf_masks: NDArray[np.bool_] | NDArray[np.uint8],
    *,
    background: float,
    transform: NDArray[np.float64],
    name: str,
    grid_class: str,
    signed_fill: bool,
) -> NDArray[np.uint8]:
    """A NanoVDB float grid from leaves in any order.

    Args:
        leaf_origins: First voxel of each leaf, multiples of 8, shape (L, 3) int32, each once.
        leaf_values: Values of the leaves, shape (L, 512) float32, z fastest.
        leaf_masks: Active voxels, shape (L, 512) bool in the order of the values, or packed (L, 64) uint8.
        background: Value outside the leaves.
        transform: Index to world, shape (4, 4).
        name: Grid name, at most 255 bytes of UTF-8.
        grid_class: "level set", "fog volume" or another class that NanoVDB has.
        signed_fill: Give empty regions that lie inside the surface the negative background (a level set).

    Returns:
        The grid: uint8, 32-byte aligned, with min, max and box of every node.

    Raises:
        InputError: A shape, origin, name, class or transform that no grid can have.
    """
    shapes = [(leaf_values, (512,)), (leaf_masks, (512,) if np.asarray(leaf_masks).dtype == np.bool_ else (64,))]
    for what, (array, row) in zip(("leaf_values", "leaf_masks"), shapes, strict=True):
        if np.shape(array) != (len(leaf_origins), *row):
            raise InputError(f"{what}: shape {np.shape(array)} is not {(len(leaf_origins), *row)}; give a row per leaf")
    layout = allocate_float_grid(
        leaf_origins,
        background=background,
        transform=transform,
        name=name,
        grid_class=grid_class,
        signed_fill=signed_fill,
    )
    for first in range(0, len(layout.order), LEAVES_AT_A_TIME):
        rows = layout.order[first : first + LEAVES_AT_A_TIME]
        layout.values[first : first + len(rows)] = leaf_values[rows]
        masks = leaf_masks[rows]
        layout.masks[first : first + len(rows)] = (
            np.packbits(masks, axis=1, bitorder="little") if masks.dtype == np.bool_ else masks
        )
    return finish(layout)


def allocate_float_grid(
    leaf_origins: NDArray[np.int32],
    *,
    background: float,
    transform: NDArray[np.float64],
    name: str,
    grid_class: str,
    signed_fill: bool,
) -> FloatGridLayout:
    """Place the nodes of a float grid; the caller writes ``values`` and ``masks`` and calls :func:`finish`.

    Arguments and errors are those of :func:`build_float_grid`.
    """
    options = checked_options(transform, name, grid_class)
    if not np.isfinite(background):
        raise InputError(f"background: {background} is not finite; give a number")
    layout = layout_of(FLOAT, "float grid")
    topology = topology_of(leaf_origins, layout, fill_gaps=signed_fill)
    # calloc's pages are zero until they are written: padding costs nothing and the leaves are touched once.
    buffer = aligned_buffer(topology.size, zeroed=True)
    begins = (topology.leaf_begin, topology.lower_begin, topology.upper_begin, topology.root_begin)
    counts = (topology.leaf_count, topology.lower_count, topology.upper_count)
    write_header(buffer, layout, options, topology.size, begins, counts)
    link_nodes(buffer, topology, layout, background)
    count = topology.leaf_count
    begin = topology.leaf_begin
    strides = (layout.leaf_size, 4)
    if count:
        values = np.ndarray((count, LEAF_VOXELS), "<f4", buffer, begin + 96, strides)
        masks = np.ndarray((count, 64), np.uint8, buffer, begin + 16, (layout.leaf_size, 1))
    else:
        values, masks = np.empty((0, LEAF_VOXELS), np.float32), np.empty((0, 64), np.uint8)
    return FloatGridLayout(buffer, topology.leaf_origins, topology.order, values, masks, topology, float(background))


def finish(layout: FloatGridLayout, *, checksum: Literal["partial", "full"] = "partial") -> NDArray[np.uint8]:
    """Complete a grid whose values and masks have been written: boxes, extrema, counts, inside tiles, checksum.

    Args:
        layout: From :func:`allocate_float_grid`.
        checksum: "partial" covers headers and root; "full" also the nodes and takes a pass over all of them. Saving to
            .nvdb computes the full one in any case.

    Returns:
        ``layout.buffer``.
    """
    buffer, topology, background = layout.buffer, layout._topology, layout._background
    float_layout = layout_of(FLOAT, "float grid")
    if topology.signed_fill and topology.leaf_count:
        _fill_signs(layout, float_layout)
    boxes, extrema, active = _leaf_statistics(layout, float_layout)
    origins = topology.leaf_origins
    for level, parent, count in (
        (LOWER, topology.leaf_lower, topology.lower_count),
        (UPPER, topology.lower_upper, topology.upper_count),
    ):
        if not count:
            break
        # Children of a node follow each other, so that one reduction per node does.
        starts = np.searchsorted(parent, np.arange(count))
        boxes, extrema = _merged(boxes, extrema, starts)
        origins = origins[starts] & ~np.int32(level.span - 1)
        level.write_statistics(buffer, topology, float_layout, origins, boxes, extrema)
    _root_statistics(buffer, topology, float_layout, boxes, extrema, background)
    tree_header(buffer)["voxel_count"] = active
    head = buffer[:HEAD_SIZE]
    grid_header(buffer)["checksum"] = (full_checksum if checksum == "full" else partial_checksum)(head, buffer)
    return buffer


def _fill_signs(layout: FloatGridLayout, float_layout: GridLayout) -> None:
    buffer, topology, background = layout.buffer, layout._topology, np.float32(layout._background)
    faces = face_signs(layout.values)
    for level, node, slot, count in (
        (LOWER, topology.leaf_lower, topology.leaf_slot, topology.lower_count),
        (UPPER, topology.lower_upper, topology.lower_slot, topology.upper_count),
    ):
        signs, faces = flood(count, level.width, node, slot, faces)
        inside_node, inside_slot = np.nonzero(signs < 0)
        level.tiles(buffer, topology, float_layout)[inside_node, inside_slot] = -background
    table = topology.root_tiles(buffer, float_layout)
    for row, below, above in topology.gaps:
        # Both ends of a gap along z show whether it lies inside: faces 5 (upper z) and 4 (lower z).
        if faces[below, 5] < 0 and faces[above, 4] < 0:
            table["value"][row] = -background


def _leaf_statistics(
    layout: FloatGridLayout, float_layout: GridLayout
) -> tuple[NDArray[np.int32], NDArray[np.float32], int]:
    buffer, topology, masks = layout.buffer, layout._topology, layout.masks
    count = topology.leaf_count
    boxes = np.empty((count, 2, 3), np.int32)
    extrema = np.empty((count, 2), np.float32)
    if not count:
        return boxes, extrema, 0
    begin, size = topology.leaf_begin, float_layout.leaf_size
    scratch = threading.local()

    def measure(first: int) -> int:
        rows = slice(first, min(first + LEAVES_AT_A_TIME, count))
        packed = np.ascontiguousarray(masks[rows])
        if not hasattr(scratch, "values"):
            scratch.values = np.empty((LEAVES_AT_A_TIME, LEAF_VOXELS), np.float32)
        _active_extrema(layout.values[rows], packed, scratch.values[: len(packed)], extrema[rows])
        local = local_boxes(packed)
        some = local[:, :1, :1] <= local[:, 1:, :1]
        boxes[rows] = np.where(some, local + topology.leaf_origins[rows, None, :], NO_BOX)
        return int(_BITS[packed].sum(dtype=np.int64))

    # NumPy lets go of the GIL in these passes, which are most of what finishing a grid takes.
    with ThreadPoolExecutor(thread_count()) as pool:
        active = sum(pool.map(measure, range(0, count, LEAVES_AT_A_TIME)))
    some = boxes[:, 0, 0] <= boxes[:, 1, 0]
    np.ndarray((count, 3), "<i4", buffer, begin, (size, 4))[:] = np.where(
        some[:, None], boxes[:, 0], topology.leaf_origins
    )
    extent = np.ndarray((count, 4), np.uint8, buffer, begin + 12, (size, 1))
    extent[:, :3] = np.where(some[:, None], boxes[:, 1] - boxes[:, 0], 0)
    extent[:, 3] = np.where(some, FLAG_HAS_BBOX, 0)
    np.ndarray((count, 2), "<f4", buffer, begin + 80, (size, 4))[:] = np.where(some[:, None], extrema, 0.0)
    return boxes, extrema, active


def _active_extrema(
    values: NDArray[np.float32], packed: NDArray[np.uint8], scratch: NDArray[np.float32], out: NDArray[np.float32]
) -> None:
    active = np.unpackbits(packed, axis=1, bitorder="little").view(np.bool_)
    for column, worst, reduce in ((0, np.inf, np.minimum.reduce), (1, -np.inf, np.maximum.reduce)):
        scratch.fill(worst)
        np.copyto(scratch, values, where=active)
        reduce(scratch, axis=1, out=out[:, column])


def local_boxes(packed: NDArray[np.uint8]) -> NDArray[np.int32]:
    """First and last active voxel of leaves within themselves, shape (L, 2, 3); first > last where none is active."""
    planes = packed.view("<u8")
    columns = np.bitwise_or.reduce(planes, axis=1, keepdims=True).view(np.uint8)
    rows = np.bitwise_or.reduce(columns, axis=1, keepdims=True)
    used = np.concatenate(
        [
            np.packbits(planes != 0, axis=1, bitorder="little"),
            np.packbits(columns != 0, axis=1, bitorder="little"),
            rows,
        ],
        axis=1,
    )
    return np.stack([_FIRST_BIT[used], _LAST_BIT[used]], axis=1).astype(np.int32)


def _merged(
    boxes: NDArray[np.int32], extrema: NDArray[np.float32], starts: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    merged = [
        reduce(boxes[:, i], starts, axis=0) for i, reduce in enumerate((np.minimum.reduceat, np.maximum.reduceat))
    ]
    limits = [reduce(extrema[:, i], starts) for i, reduce in enumerate((np.minimum.reduceat, np.maximum.reduceat))]
    return np.stack(merged, axis=1), np.stack(limits, axis=1)


def _root_statistics(
    buffer: NDArray[np.uint8],
    topology: Topology,
    float_layout: GridLayout,
    boxes: NDArray[np.int32],
    extrema: NDArray[np.float32],
    background: float,
) -> None:
    root = buffer[topology.root_begin :]
    box = root[:24].view("<i4").reshape(2, 3)
    box[0], box[1] = np.iinfo(np.int32).max, np.iinfo(np.int32).min
    limits = np.full(2, background, np.float32)
    if len(boxes):
        box[0], box[1] = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    some = bool((box[0] <= box[1]).all())
    if some:
        limits[:] = extrema[:, 0].min(), extrema[:, 1].max()
    root[float_layout.root_background : float_layout.root_background + 12].view("<f4")[:] = (background, *limits)
    root_span(buffer, box if some else None)
