"""Prepares a grid for ray kernels: its buffer, the box outside of which all is background, and an anchor voxel."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.late_warp import wp
from geokit.errors import UnsupportedGridError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.nodes import bits_of, grid_nodes, root_origins
from geokit.volume.nanovdb.types import SCALAR_TYPES

# Voxels this near the ends of int32 count as background, because borders of blocks must be int32 numbers too.
OUTERMOST_VOXEL = 2**31 - 16
# Edges [voxels] of a root entry's region and of a leaf.
ROOT_SPAN = 4096
LEAF_SPAN = 8


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
    grid = grid_nodes(buffer)
    # Compared as bits, so that NaN equals itself; that -0.0 then differs from 0.0 does no harm.
    bits = np.dtype(f"<u{grid.root.layout.background.itemsize}")
    background, table = grid.background.view(bits), grid.table
    is_tile = (table["child"] == 0) & (table["value"].view(bits) != background)
    tiles = root_origins(table["key"][is_tile]).astype(np.int64)
    boxes = [np.stack([tiles, tiles + ROOT_SPAN - 1], axis=1)]
    upper = grid.upper_places().origins
    for level, origins in ((grid.upper, upper), (grid.lower, grid.upper.children(upper).origins)):
        for first, part in level.parts():
            child = bits_of(part.child_mask)
            used = ~child & (part.values.view(bits) != background)
            if level.span == LEAF_SPAN:
                used |= child
            rows = origins[first : first + part.count].astype(np.int64)
            boxes.append(_boxes_of(rows, used.reshape(-1, *3 * (level.width,)), level.span))
    found = np.concatenate(boxes)
    if not len(found):
        return None
    box = np.stack([found[:, 0].min(axis=0), found[:, 1].max(axis=0)])
    return np.clip(box, -OUTERMOST_VOXEL, OUTERMOST_VOXEL)


def _boxes_of(origins: NDArray[np.int64], used: NDArray[np.bool_], span: int) -> NDArray[np.int64]:
    """First and last voxel (N, 2, 3) of the used slots (N, W, W, W) of nodes; nodes without used slots are left out."""
    some = used.any(axis=(1, 2, 3))
    used, origins = used[some], origins[some]
    lines: list[NDArray[np.bool_]] = [np.asarray(used.any(axis=axes)) for axes in ((2, 3), (1, 3), (1, 2))]
    low = np.stack([line.argmax(axis=1) for line in lines], axis=1)
    high = np.stack([line.shape[1] - line[:, ::-1].argmax(axis=1) for line in lines], axis=1)
    return np.stack([origins + span * low, origins + span * high - 1], axis=1)
