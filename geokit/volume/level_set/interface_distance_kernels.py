"""Distances at the corners of crossed cells, chosen so that the surface does not move."""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.level_set.leaf_neighbors_kernels import value_at
from geokit.volume.level_set.mask_dilation_kernels import corners_in_plane

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# Slopes this close to 1 mean that the values are distances already, and they keep their bits. It is the error of
# differences on a sphere of five voxels' radius.
UNIT_SLOPE = wp.constant(wp.float64(0.01))
# A corner of a crossed cell is no farther from the surface than a cell's diagonal.
FARTHEST_FOOT = wp.constant(wp.float64(1.8))


@cpp.func_native("volume/level_set/interface_distance.inl")
def slope_near(
    slopes: wp.array(dtype=wp.float32), beside: wp.array2d(dtype=int), t: int, x: int, y: int, z: int, point: wp.vec3d
) -> wp.vec4d:
    """Slope of the field at ``point`` and its gradient, from the crossed cells around the voxel (x, y, z) of row t.

    ``point`` is relative to the voxel.
    """
    ...


@wp.kernel
def cell_slopes_kernel(
    first: int,
    values: wp.array(dtype=wp.float64),
    inside: wp.array(dtype=wp.uint64),
    beside: wp.array2d(dtype=int),
    background: wp.float64,
    isovalue: wp.float64,
    voxel_size: wp.float64,
    out_slopes: wp.array(dtype=wp.float32),
    out_crossed: wp.array(dtype=wp.uint64),
):
    """Slopes in the cells that start at the voxels of a plane; -1 for cells that the surface does not cross."""
    i = first + wp.tid()
    t = i >> 3
    x = i & 7
    outer = background - isovalue
    inner = -background - isovalue
    # In most leaves, most planes are far from the surface; these end here.
    here = inside[i]
    crossed = wp.uint64(0)
    plain = here == wp.uint64(0) or here == ~wp.uint64(0)
    for n in range(64):
        y = n >> 3
        z = n & 7
        slope = wp.float32(-1.0)
        open = True
        if plain and x < 7 and y < 7 and z < 7:
            open = inside[i + 1] != here
        if open:
            c0 = value_at(values, beside, outer, inner, t, x, y, z)
            c1 = value_at(values, beside, outer, inner, t, x, y, z + 1)
            c2 = value_at(values, beside, outer, inner, t, x, y + 1, z)
            c3 = value_at(values, beside, outer, inner, t, x, y + 1, z + 1)
            c4 = value_at(values, beside, outer, inner, t, x + 1, y, z)
            c5 = value_at(values, beside, outer, inner, t, x + 1, y, z + 1)
            c6 = value_at(values, beside, outer, inner, t, x + 1, y + 1, z)
            c7 = value_at(values, beside, outer, inner, t, x + 1, y + 1, z + 1)
            o = wp.float64(0.0)
            side = c0 < o
            same = (c1 < o) == side and (c2 < o) == side and (c3 < o) == side and (c4 < o) == side
            if not (same and (c5 < o) == side and (c6 < o) == side and (c7 < o) == side):
                g = wp.vec3d(
                    c4 + c5 + c6 + c7 - c0 - c1 - c2 - c3,
                    c2 + c3 + c6 + c7 - c0 - c1 - c4 - c5,
                    c1 + c3 + c5 + c7 - c0 - c2 - c4 - c6,
                )
                slope = wp.float32(wp.float64(0.25) * wp.length(g) / voxel_size)
                crossed = crossed | (wp.uint64(1) << wp.uint64(n))
        out_slopes[(i << 6) + n] = slope
    out_crossed[i] = crossed


@wp.kernel
def seeds_kernel(
    first: int,
    values: wp.array(dtype=wp.float64),
    active: wp.array(dtype=wp.uint64),
    slopes: wp.array(dtype=wp.float32),
    crossed: wp.array(dtype=wp.uint64),
    beside: wp.array2d(dtype=int),
    background: wp.float64,
    isovalue: wp.float64,
    voxel_size: wp.float64,
    out_distance: wp.array(dtype=wp.float64),
    out_held: wp.array(dtype=wp.uint64),
    out_rise: wp.array(dtype=wp.vec3f),
):
    """Distances of the active corners of crossed cells in a plane, and the bit mask of these voxels.

    Both ends of an edge across the surface are divided by the slope at about the same point, so the crossing stays.
    """
    i = first + wp.tid()
    t = i >> 3
    x = i & 7
    outer = background - isovalue
    inner = -background - isovalue
    held = wp.uint64(0)
    # In bands narrower than a cell, some corners are inactive: they hold the background, which is no distance.
    word = active[i]
    if word != wp.uint64(0):
        word = word & (corners_in_plane(crossed, beside, t, x) | corners_in_plane(crossed, beside, t, x - 1))
    if word != wp.uint64(0):
        for n in range(64):
            if ((word >> wp.uint64(n)) & wp.uint64(1)) != wp.uint64(0):
                y = n >> 3
                z = n & 7
                value = values[(i << 6) + n]
                g = wp.float64(0.5) * wp.vec3d(
                    value_at(values, beside, outer, inner, t, x + 1, y, z)
                    - value_at(values, beside, outer, inner, t, x - 1, y, z),
                    value_at(values, beside, outer, inner, t, x, y + 1, z)
                    - value_at(values, beside, outer, inner, t, x, y - 1, z),
                    value_at(values, beside, outer, inner, t, x, y, z + 1)
                    - value_at(values, beside, outer, inner, t, x, y, z - 1),
                )
                step = wp.vec3d()
                if wp.length_sq(g) > wp.float64(0.0):
                    step = g * (value / wp.length_sq(g))
                if wp.length(step) > FARTHEST_FOOT:
                    step = step * (FARTHEST_FOOT / wp.length(step))
                found = slope_near(slopes, beside, t, x, y, z, -step)
                slope = found[0]
                if slope > wp.float64(0.0) and wp.isfinite(slope):
                    out_rise[(i << 6) + n] = wp.vec3f(wp.vec3d(found[1], found[2], found[3]) / slope)
                else:
                    slope = wp.float64(1.0)
                    out_rise[(i << 6) + n] = wp.vec3f()
                if wp.abs(slope - wp.float64(1.0)) < UNIT_SLOPE:
                    slope = wp.float64(1.0)
                out_distance[(i << 6) + n] = value / slope
                held = held | (wp.uint64(1) << wp.uint64(n))
    out_held[i] = held
