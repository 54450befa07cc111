"""Leaves of the trees: triangles side by side, eight on a CPU and one on CUDA, each in a float32 frame of its own.

A triangle's frame has its origin at a corner, x along its longest edge, y in its plane and z along its normal. In this
frame a distance is that of a point from a flat triangle, and every step is a rotation or a projection. So the error is
that of moving the query by a few roundings, also for slivers and triangles without area. (Barycentric coordinates from
the corners lose digits with the square of the distance or of the thinness.)
"""

# mypy: ignore-errors
import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Rows of eight in a block: origin 0-2, x 3-5, y 6-8, z 9-11, length of the edge along x 12, third corner 13 14,
# 1 / squared length of the edges first to third corner 15 and second to third corner 16.
PLANE_ROWS = 17
# On CUDA each slot is one row of numbers, padded to whole 16-byte words.
SLOT_WORDS = 20
# Position of an empty slot: its square is finite in float32 and beyond any search radius.
NOWHERE = 1.0e18
# Ratio of a triangle's height to its longest edge, below which it counts as a segment: the error of its points is then
# less than the rounding of float64 coordinates.
FLAT = 1.0e-13
# Squared lengths below this count as zero, because their reciprocal would overflow float32.
SHORTEST = 1.0e-36


@wp.func
def put(out: wp.array(dtype=wp.float32), slot: int, row: int, value: wp.float64):
    out[SLOT_WORDS * slot + row] = wp.float32(value)


@wp.func
def reciprocal_or_zero(x: wp.float64) -> wp.float64:
    r = wp.float64(0.0)
    if x > wp.float64(SHORTEST):
        r = wp.float64(1.0) / x
    return r


@wp.func
def unit_or(v: wp.vec3d, fallback: wp.vec3d) -> wp.vec3d:
    size = wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))
    result = fallback
    if size > wp.float64(0.0):
        result = wp.normalize(v / size)
    return result


@wp.func
def across(x: wp.vec3d) -> wp.vec3d:
    """A unit vector perpendicular to the unit vector x."""
    one = wp.float64(1.0)
    zero = wp.float64(0.0)
    axis = wp.vec3d(one, zero, zero)
    if wp.abs(x[0]) > wp.float64(0.7):
        axis = wp.vec3d(zero, one, zero)
    return wp.normalize(axis - wp.dot(axis, x) * x)


@wp.kernel
def leaf_planes_kernel(
    first: int,
    slot_triangle: wp.array(dtype=int),
    corners: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    scale: wp.float64,
    out_leaves: wp.array(dtype=wp.float32),
):
    """One row for each slot, for CUDA; bvh8_leaves_cpu.inl is the same for blocks of eight."""
    slot = first + wp.tid()
    zero = wp.float64(0.0)
    a = wp.vec3d(wp.float64(NOWHERE), zero, zero)
    b = a
    c = a
    if slot_triangle[slot] >= 0:
        a = (corners[3 * slot] - origin) / scale
        b = (corners[3 * slot + 1] - origin) / scale
        c = (corners[3 * slot + 2] - origin) / scale
        # Rotated so that the longest edge runs from a to b: then c is well away from both.
        ab = wp.length_sq(b - a)
        bc = wp.length_sq(c - b)
        ca = wp.length_sq(a - c)
        if bc > ab and bc >= ca:
            t = a
            a = b
            b = c
            c = t
        elif ca > ab:
            t = a
            a = c
            c = b
            b = t
    x = unit_or(b - a, wp.vec3d(wp.float64(1.0), zero, zero))
    cx = wp.dot(c - a, x)
    rest = (c - a) - cx * x
    y = across(x)
    # Without area, the component of c off the edge is rounding in any direction: any plane through the edge will do.
    if wp.length(rest) > wp.float64(FLAT) * wp.length(b - a):
        y = wp.normalize(rest)
        # Orthogonalized against x once more: a remaining component along x would tilt the plane of a sliver.
        y = wp.normalize(y - wp.dot(y, x) * x)
    z = wp.cross(x, y)
    cy = wp.dot(c - a, y)
    length = wp.dot(b - a, x)
    if slot_triangle[slot] < 0:
        # No point is inside an edge of negative length, whatever the margin.
        length = wp.float64(-1.0)
    for k in range(3):
        put(out_leaves, slot, k, a[k])
        put(out_leaves, slot, 3 + k, x[k])
        put(out_leaves, slot, 6 + k, y[k])
        put(out_leaves, slot, 9 + k, z[k])
    put(out_leaves, slot, 12, length)
    put(out_leaves, slot, 13, cx)
    put(out_leaves, slot, 14, cy)
    put(out_leaves, slot, 15, reciprocal_or_zero(cx * cx + cy * cy))
    put(out_leaves, slot, 16, reciprocal_or_zero((cx - length) * (cx - length) + cy * cy))
