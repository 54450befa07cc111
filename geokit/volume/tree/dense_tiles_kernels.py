"""Tiles of 8^3 voxels of a dense array: which of them become leaves, and the leaves' values and masks.

Rows along z are contiguous.
"""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.cpp import cpp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# States of a tile.
OUTSIDE = wp.constant(0)
LEAF = wp.constant(1)
INSIDE = wp.constant(2)
BAD = wp.constant(3)


@wp.func
def is_active(value: wp.float32, background: wp.float32, tolerance: wp.float64, level_set: int) -> bool:
    """Whether a value differs from the background by more than the tolerance; in a level set, from both its signs."""
    level = value
    if level_set != 0:
        level = wp.abs(value)
    return wp.abs(wp.float64(level) - wp.float64(background)) > tolerance


@wp.func_native(cpp("volume/tree/row_counts.inl", defines={"TYPE": "float"}))
def row_counts(
    dense: wp.array3d(dtype=wp.float32), i: int, j: int, k: int, count: int, background: wp.float32,
    tolerance: wp.float64, level_set: int,
) -> int: ...  # fmt: skip


@wp.func_native(cpp("volume/tree/row_counts.inl", defines={"TYPE": "double"}))
def row_counts(  # noqa: F811
    dense: wp.array3d(dtype=wp.float64), i: int, j: int, k: int, count: int, background: wp.float32,
    tolerance: wp.float64, level_set: int,
) -> int: ...  # fmt: skip


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
    k = wp.max(z, 0)
    run = wp.min(z + 8, dense.shape[2]) - k
    active = int(0)
    negative = int(0)
    bad = int(0)
    for i in range(wp.max(x, 0), wp.min(x + 8, dense.shape[0])):
        for j in range(wp.max(y, 0), wp.min(y + 8, dense.shape[1])):
            counts = row_counts(dense, i, j, k, run, background, tolerance, level_set)
            active += counts & 255
            negative += (counts >> 8) & 255
            bad += counts >> 16
    state = int(OUTSIDE)
    if active > 0:
        state = int(LEAF)
    elif level_set != 0 and negative > 0:
        # A block with both signs cannot be a tile, so it is a leaf without active voxels.
        state = int(LEAF)
        if negative == 512:
            state = int(INSIDE)
    if bad > 0:
        state = int(BAD)
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
    row = rows[t]
    x = 8 * tiles[t, 0] - shift[0]
    y = 8 * tiles[t, 1] - shift[1]
    z = 8 * tiles[t, 2] - shift[2]
    for n in range(64):
        i = x + n // 8
        j = y + n % 8
        inside = i >= 0 and j >= 0 and i < dense.shape[0] and j < dense.shape[1]
        mask = wp.uint8(0)
        for k in range(8):
            value = background
            if inside and z + k >= 0 and z + k < dense.shape[2]:
                value = wp.float32(dense[i, j, z + k])
                if is_active(value, background, tolerance, level_set):
                    mask = mask | (wp.uint8(1) << wp.uint8(k))
                elif level_set != 0 and value < wp.float32(0.0):
                    value = -background
                else:
                    value = background
            out_values[row, 8 * n + k] = value
        out_masks[row, n] = mask


for _dtype in (wp.float32, wp.float64):
    wp.overload(tile_state_kernel, {"dense": wp.array3d(dtype=_dtype)})
    wp.overload(fill_tiles_kernel, {"dense": wp.array3d(dtype=_dtype)})
