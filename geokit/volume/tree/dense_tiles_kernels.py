"""Tiles of 8^3 voxels of a dense array: which of them become leaves, and the leaves' values and masks.

Rows along z are contiguous.
"""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# States of a tile.
OUTSIDE = 0
LEAF = 1
INSIDE = 2
BAD = 3


STATES = {"OUTSIDE": OUTSIDE, "LEAF": LEAF, "INSIDE": INSIDE, "BAD": BAD}


@wp.kernel
@cpp.native_item("volume/tree/dense_tiles_cpu.inl", "write_state", **STATES)
def tile_state_kernel(first: int, dense: wp.array3d(dtype=Any), out_state: wp.array3d(dtype=wp.uint8)):
    """Marks tiles with an active voxel or both signs as leaves. ``shift``: the array's place in its first tile."""


@wp.kernel
@cpp.native_item("volume/tree/dense_tiles_cpu.inl", "fill_tile", **STATES)
def fill_tiles_kernel(
    first: int,
    dense: wp.array3d(dtype=Any),
    tiles: wp.array2d(dtype=wp.int32),
    out_values: wp.array2d(dtype=wp.float32),
    out_masks: wp.array2d(dtype=wp.uint8),
):
    """Values and mask of tile ``tiles[t]``, written to row ``rows[t]``; inactive voxels take the background's value."""


for _dtype in (wp.float32, wp.float64):
    wp.overload(tile_state_kernel, {"dense": wp.array3d(dtype=_dtype)})
    wp.overload(fill_tiles_kernel, {"dense": wp.array3d(dtype=_dtype)})
