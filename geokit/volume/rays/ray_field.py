"""Prepares a grid for ray kernels: its buffer, the box outside of which all is background, and an anchor voxel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import user_arrays
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume._model import SparseVolume
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.header import TREE_OFFSET, grid_header, tree_header
from geokit.volume.nanovdb.layout import GridLayout, layout_of
from geokit.volume.nanovdb.types import SCALAR_TYPES

if TYPE_CHECKING:
    import warp as wp

__all__ = ["LEAF_SPAN", "anchor_of", "ray_field", "read_rays", "refuse_bad_rays", "stored_box"]

# Voxels this near the ends of int32 count as background, because borders of blocks must be int32 numbers too.
OUTERMOST_VOXEL = 2**31 - 16
# Edges [voxels] of a root entry's region and of a leaf.
ROOT_SPAN = 4096
LEAF_SPAN = 8
# Nodes whose slots are scanned together; the slots of 64 upper nodes take 16 MiB.
NODES_AT_A_TIME = 64


def ray_field(volume: SparseVolume, device: "wp.Device", *others: SparseVolume) -> Any:
    """The RayField of a grid, as kernels take it.

    Args:
        volume: A grid of one component.
        device: Device of the kernels.
        others: Grids with the same transform that are traversed together with it; the box encloses all of them.
    Returns:
        A RayField.
    Raises:
        UnsupportedGridError: The grid has several components, or no values at all.
    """
    import warp as wp

    from geokit.volume.rays.raycast_kernels import RayField

    for grid in (volume, *others):
        if grid.info.grid_type not in SCALAR_TYPES:
            raise UnsupportedGridError(
                f"volume: grid {grid.info.name!r} of type {grid.info.grid_type} has no single value along a ray; use a "
                f"grid of type {', '.join(SCALAR_TYPES)}"
            )
    field = RayField()
    field.volume = wp.uint64(volume.id(device))
    boxes = [box for box in map(stored_box, (volume, *others)) if box is not None]
    if not boxes:
        anchor = np.zeros(3, np.int64)
        lower = upper = np.zeros(3)
    else:
        box = np.stack([np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]])
        anchor = anchor_of(box)
        # A cell reads its lowest voxel and the next, so the first stored voxel also belongs to the cell below.
        lower, upper = box[0] - 1.0 - anchor, box[1] + 1.0 - anchor
    linear = volume.info.transform[:3, :3]
    # One rounding only: the common part of product and translation cancels in the wider type.
    corner = np.asarray(linear, np.longdouble) @ anchor.astype(np.longdouble) + volume.info.transform[:3, 3]
    field.corner = wp.vec3d(*map(float, corner))
    field.to_index = wp.mat33d(*np.linalg.inv(linear).ravel().tolist())
    field.anchor = wp.vec3i(*anchor.tolist())
    field.reach = wp.empty(0, dtype=wp.int8, device=device)
    field.numbers = wp.empty(0, dtype=wp.int32, device=device)
    field.blocks = wp.empty(0, dtype=wp.uint64, device=device)
    field.lower, field.upper = wp.vec3d(*lower.tolist()), wp.vec3d(*upper.tolist())
    return field


def read_rays(origins: Any, directions: Any, device: "wp.Device") -> tuple[user_arrays.Batch, user_arrays.Batch]:
    """Origins and directions as batches of equal length. The kernel checks their rows.

    Args:
        origins: Shape (N, 3).
        directions: Shape (N, 3).
        device: Device of the kernels.
    Returns:
        Both batches.
    Raises:
        InputError: A wrong shape or dtype, or lengths that differ.
    """
    rays = user_arrays.read_vectors(origins, "origins", device, defer=True)
    heading = user_arrays.read_vectors(directions, "directions", device, defer=True)
    if len(rays) != len(heading):
        raise InputError(f"directions: {len(heading)} rows for {len(rays)} origins; give one direction for each")
    return rays, heading


def refuse_bad_rays(rays: user_arrays.Batch, heading: user_arrays.Batch) -> None:
    """Raise for the first row that a kernel found unusable.

    Raises:
        InputError: A row is not finite, or a direction is zero.
    """
    from geokit.volume.rays.raycast_kernels import SHORTEST_DIRECTION

    user_arrays.require_finite(rays, "origins")
    user_arrays.require_finite(heading, "directions")
    user_arrays.require_length(heading, "directions", float(SHORTEST_DIRECTION))


def stored_box(volume: SparseVolume) -> NDArray[np.int64] | None:
    """First and last voxel (2, 3) of the box around everything but background tiles; None for an empty grid.

    The box may be wider than the active voxels, because the interpolant also reads inactive values. It is cached per
    volume.
    """

    def find() -> NDArray[np.int64] | None:
        check_volume(volume)  # the offsets are followed as they stand
        return _find_box(volume.nanovdb)

    return volume._cache.find("stored box", find)


def anchor_of(box: NDArray[np.int64]) -> NDArray[np.int64]:
    """The first voxel of the leaf in the middle of a box, shape (3,)."""
    return box.sum(axis=0) // 2 & ~(LEAF_SPAN - 1)


def _find_box(buffer: NDArray[np.uint8]) -> NDArray[np.int64] | None:
    layout = layout_of(int(grid_header(buffer)["grid_type"]), "volume")
    tree = tree_header(buffer)
    root, upper, lower = (TREE_OFFSET + int(tree["node_offset"][level]) for level in (3, 2, 1))
    # Compared as bits, so that NaN equals itself; that -0.0 then differs from 0.0 does no harm.
    bits = np.dtype(f"<u{layout.background.itemsize}")
    background = buffer[root + layout.root_background :][: bits.itemsize].view(bits)[0]

    count = int(buffer[root + 24 : root + 28].view("<u4")[0])
    table = buffer[root + layout.root_size :][: count * layout.root_tile_size].reshape(count, layout.root_tile_size)
    key = table[:, :8].copy().view("<u8")[:, 0]
    child = table[:, 8:16].copy().view("<i8")[:, 0]
    at = -(-20 // layout.align) * layout.align
    tile = np.ascontiguousarray(table[:, at : at + bits.itemsize]).view(bits)[:, 0]
    # A key has 20 bits of each coordinate, z lowest; the left shift puts their sign bit in place.
    parts = np.stack([key >> np.uint64(42), key >> np.uint64(21), key], axis=1).astype(np.uint32)
    origins = (parts << np.uint32(12)).view(np.int32).astype(np.int64)
    boxes = [np.stack([origins, origins + ROOT_SPAN - 1], axis=1)[(child == 0) & (tile != background)]]
    at_nodes, origins = child[child != 0] + root, origins[child != 0]
    for begin, size, offset, width, span in (
        (upper, layout.upper_size, layout.upper_table, 32, 128),
        (lower, layout.lower_size, layout.lower_table, 16, 8),
    ):
        order = np.argsort(at_nodes)
        assert (at_nodes[order] == begin + size * np.arange(len(order))).all(), "check_grid has seen to that"
        origins = origins[order]
        children, at_children = [], []
        for first in range(0, len(origins), NODES_AT_A_TIME):
            rows = origins[first : first + NODES_AT_A_TIME]
            start = begin + first * size
            tiles, found, offsets = _slots(buffer, len(rows), start, size, offset, width**3, layout, background)
            used = tiles | found if span == LEAF_SPAN else tiles
            boxes.append(_boxes_of(rows, used.reshape(-1, width, width, width), span))
            node, slot = np.nonzero(found)
            cell = np.stack([slot // width**2, slot // width % width, slot % width], axis=1)
            children.append(rows[node] + span * cell)
            at_children.append(start + node * size + offsets[node, slot])
        origins = np.concatenate(children) if children else origins[:0]
        at_nodes = np.concatenate(at_children) if children else at_nodes[:0]
    found = np.concatenate(boxes)
    if not len(found):
        return None
    box = np.stack([found[:, 0].min(axis=0), found[:, 1].max(axis=0)])
    return np.clip(box, -OUTERMOST_VOXEL, OUTERMOST_VOXEL)


def _slots(
    buffer: NDArray[np.uint8],
    count: int,
    start: int,
    size: int,
    table: int,
    slots: int,
    layout: GridLayout,
    background: Any,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.int64]]:
    """For ``count`` nodes: slots of tiles other than background, slots of children, and the children's offsets."""
    mask = np.ndarray((count, slots // 8), np.uint8, buffer, start + 32 + slots // 8, (size, 1))
    found = np.unpackbits(mask, axis=1, bitorder="little").view(np.bool_)
    values = np.ndarray((count, slots), background.dtype, buffer, start + table, (size, layout.table_stride))
    offsets: NDArray[np.int64] = np.ndarray((count, slots), "<i8", buffer, start + table, (size, layout.table_stride))
    return ~found & (values != background), found, offsets


def _boxes_of(origins: NDArray[np.int64], used: NDArray[np.bool_], span: int) -> NDArray[np.int64]:
    """First and last voxel (N, 2, 3) of the used slots (N, W, W, W) of nodes; nodes without used slots are left out."""
    some = used.any(axis=(1, 2, 3))
    used, origins = used[some], origins[some]
    lines: list[NDArray[np.bool_]] = [np.asarray(used.any(axis=axes)) for axes in ((2, 3), (1, 3), (1, 2))]
    low = np.stack([line.argmax(axis=1) for line in lines], axis=1)
    high = np.stack([line.shape[1] - line[:, ::-1].argmax(axis=1) for line in lines], axis=1)
    return np.stack([origins + span * low, origins + span * high - 1], axis=1)
