"""Errors of a cell's trilinear interpolant against the exact distance, in the part of the cell near the surface.

If q is the closest point of p on the surface, it is the closest point of every point on the segment from q to p. So one
query at p gives exact distances on the whole segment, and thus next to the surface, where they matter.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.sampling.sample_kernels import trilinear

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

vec8d = wp.types.vector(length=8, dtype=wp.float64)

# Test points on a segment, from the surface to the zone's edge, both included.
PLACES = wp.constant(4)
# Share of a voxel by which rounding may put a position on the border outside its cell.
SLACK = wp.constant(wp.float64(1e-9))


@wp.func
def outside_cell(f: wp.vec3d) -> bool:
    return wp.min(f) < -SLACK or wp.max(f) > wp.float64(1.0) + SLACK


@wp.func
def error_along(
    p: wp.vec3d, q: wp.vec3d, d: wp.float64, base: wp.vec3d, size: wp.float64, within: wp.float64, c: vec8d
) -> wp.float64:
    """Largest error on the part of the segment from q to p that lies in the cell and in the zone."""
    worst = wp.float64(0.0)
    length = wp.abs(d)
    for step in range(PLACES):
        a = wp.min(length, within * wp.float64(step) / wp.float64(PLACES - 1))
        x = q
        if length > wp.float64(0.0):
            x = q + (p - q) * (a / length)
        f = (x - base) / size
        if not outside_cell(f):
            exact = wp.where(d < wp.float64(0.0), -a, a)
            value = trilinear(c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], f)
            worst = wp.max(worst, wp.abs(value - exact))
    return worst


@wp.func
def corner_values(n: int, corner: wp.array(dtype=int), distance: wp.array(dtype=wp.float64)) -> vec8d:
    """Values of the cell's voxels as a grid stores them."""
    c = vec8d()
    for k in range(8):
        c[k] = wp.float64(wp.float32(distance[corner[8 * n + k]]))
    return c


@wp.func
def corner_position(base: wp.vec3d, size: wp.float64, k: int) -> wp.vec3d:
    return base + size * wp.vec3d(wp.float64(k / 4), wp.float64(k / 2 % 2), wp.float64(k % 2))


@wp.kernel
def examine_kernel(
    first: int,
    cells: wp.array(dtype=wp.vec3i),
    corner: wp.array(dtype=int),
    distance: wp.array(dtype=wp.float64),
    closest: wp.array(dtype=wp.vec3d),
    center_distance: wp.array(dtype=wp.float64),
    center_closest: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    size: wp.float64,
    within: wp.float64,
    out_error: wp.array(dtype=wp.float64),
    out_spread: wp.array(dtype=wp.float64),
):
    """Errors along the segments of a cell's voxels and of its center, and the spread of the segments' directions."""
    n = first + wp.tid()
    base = origin + size * wp.vec3d(cells[n])
    c = corner_values(n, corner, distance)
    p = base + wp.vec3d(wp.float64(0.5) * size)
    d = center_distance[n]
    worst = error_along(p, center_closest[n], d, base, size, within, c)
    # A center on the surface has no direction; the voxels' directions are then compared with each other.
    known = wp.abs(d) > SLACK * size
    middle = wp.vec3d()
    if known:
        middle = (p - center_closest[n]) / d
    spread = wp.float64(0.0)
    for k in range(8):
        v = corner[8 * n + k]
        p = corner_position(base, size, k)
        d = distance[v]
        worst = wp.max(worst, error_along(p, closest[v], d, base, size, within, c))
        if wp.abs(d) > SLACK * size:
            direction = (p - closest[v]) / d
            if not known:
                known = True
                middle = direction
            spread = wp.max(spread, wp.length(direction - middle))
    out_error[n] = worst
    out_spread[n] = spread


@wp.kernel
def inspect_kernel(
    first: int,
    cells: wp.array(dtype=wp.vec3i),
    corner: wp.array(dtype=int),
    distance: wp.array(dtype=wp.float64),
    count: int,
    points: wp.array(dtype=wp.vec3d),
    point_distance: wp.array(dtype=wp.float64),
    point_closest: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    size: wp.float64,
    within: wp.float64,
    out_error: wp.array(dtype=wp.float64),
):
    """Errors along the segments of ``count`` points in each cell."""
    n = first + wp.tid()
    base = origin + size * wp.vec3d(cells[n])
    c = corner_values(n, corner, distance)
    worst = wp.float64(0.0)
    for k in range(count):
        i = count * n + k
        worst = wp.max(worst, error_along(points[i], point_closest[i], point_distance[i], base, size, within, c))
    out_error[n] = worst
