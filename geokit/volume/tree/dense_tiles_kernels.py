"""Tiles of 8^3 voxels of a dense array: which of them become leaves, and the leaves' values and masks.

Rows along z are contiguous.
"""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# States of a tile.
OUTSIDE = 0
LEAF = 1
INSIDE = 2
BAD = 3


STATES = {"OUTSIDE": OUTSIDE, "LEAF": LEAF, "INSIDE": INSIDE, "BAD": BAD}


# Warp takes no Any where something is returned.
for _dtype in (wp.float32, wp.float64):

    @cpp.func_native("volume/tree/dense_tiles_cpu.inl", **STATES)
    def tile_state(
        dense: wp.array3d(dtype=_dtype), x: int, y: int, z: int, background: wp.float32, tolerance: wp.float64,
        level_set: int,
    ) -> int: ...  # fmt: skip


@cpp.func_native("volume/tree/dense_tiles_cpu.inl", **STATES)
def fill_tile(
    dense: wp.array3d(dtype=Any), x: int, y: int, z: int, background: wp.float32, tolerance: wp.float64,
    level_set: int, row: int, out_values: wp.array2d(dtype=wp.float32), out_masks: wp.array2d(dtype=wp.uint8),
): ...  # fmt: skip


@wp.kernel
def tile_state_kernel(
    first: int,
    dense: wp.array3d(dtype=Any),
    shift: wp.vec3i,
    count_y: int,
    count_z: int,
    background: wp.float32,
    tolerance: wp.float64,
    level_set: int,
    out_state: wp.array3d(dtype=wp.uint8),
):
    """Marks tiles with an active voxel or both signs as leaves. ``shift``: the array's place in its first tile."""
    tile = first + wp.tid()
    z = 8 * (tile % count_z) - shift[2]
    y = 8 * ((tile // count_z) % count_y) - shift[1]
    x = 8 * (tile // (count_z * count_y)) - shift[0]
    state = tile_state(dense, x, y, z, background, tolerance, level_set)
    out_state[tile // (count_z * count_y), (tile // count_z) % count_y, tile % count_z] = wp.uint8(state)


@wp.kernel
def fill_tiles_kernel(
    first: int,
    dense: wp.array3d(dtype=Any),
    shift: wp.vec3i,
    tiles: wp.array2d(dtype=wp.int32),
    rows: wp.array(dtype=wp.int32),
    background: wp.float32,
    tolerance: wp.float64,
    level_set: int,
    out_values: wp.array2d(dtype=wp.float32),
    out_masks: wp.array2d(dtype=wp.uint8),
):
    """Values and mask of tile ``tiles[t]``, written to row ``rows[t]``; inactive voxels take the background's value."""
    t = first + wp.tid()
    x = 8 * tiles[t, 0] - shift[0]
    y = 8 * tiles[t, 1] - shift[1]
    z = 8 * tiles[t, 2] - shift[2]
    fill_tile(dense, x, y, z, background, tolerance, level_set, rows[t], out_values, out_masks)


for _dtype in (wp.float32, wp.float64):
    wp.overload(tile_state_kernel, {"dense": wp.array3d(dtype=_dtype)})
    wp.overload(fill_tiles_kernel, {"dense": wp.array3d(dtype=_dtype)})
