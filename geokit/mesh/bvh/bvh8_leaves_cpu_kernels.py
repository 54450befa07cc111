"""Leaves of the CPU tree: eight triangles side by side, each in a float32 frame of its own.

A triangle's frame has its origin at a corner, x along its longest edge, y in its plane and z along its normal. In this
frame a distance is that of a point from a flat triangle, and every step is a rotation or a projection. So the error is
that of moving the query by a few roundings, also for slivers and triangles without area. (Barycentric coordinates from
the corners lose digits with the square of the distance or of the thinness.)
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import numpy as np
import warp as wp

from geokit.core.cpp import cpp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Rows of eight in a block: origin 0-2, x 3-5, y 6-8, z 9-11, length of the edge along x 12, third corner 13 14,
# 1 / squared length of the edges first to third corner 15 and second to third corner 16.
PLANE_ROWS = 17
# On CUDA each slot is one row of numbers, padded to whole 16-byte words.
SLOT_WORDS = 20
# Words of a ray leaf: nine rows of eight 16-bit numbers, then the HEAD; see pack_ray_leaf_bvh8_cpu.inl.
LEAF_WORDS = 48
HEAD = 36
# Ratio of a triangle's height to its longest edge, below which t is that of the plane; see refine_sliver.inl.
SLIVER = np.float32(1e-3)
# Rounding error of a ray across its direction, in local units: coordinates up to 2, differences up to 3, and slopes
# times those, each rounded by 6e-8, add up to 1.3e-6 in the worst case.
RAY_ERROR = 2.5e-6
# Least quantum: 1 / quantum, and its products with what RAY_ERROR leaves, stay small in float32.
LEAST_QUANTUM = 2.0**-30
# Position of an empty slot: its square is finite in float32 and beyond any search radius.
NOWHERE = 1.0e18
# Ratio of a triangle's height to its longest edge, below which it counts as a segment: the error of its points is then
# less than the rounding of float64 coordinates.
FLAT = wp.constant(wp.float64(1.0e-13))


@wp.func
def put(out: wp.array(dtype=wp.float32), start: int, row: int, lanes: int, value: wp.float64):
    out[start + row * lanes] = wp.float32(value)


@wp.func
def reciprocal_or_zero(x: wp.float64) -> wp.float64:
    # Shorter lengths count as zero, because their reciprocal would overflow float32.
    r = wp.float64(0.0)
    if x > wp.float64(1.0e-36):
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
    lanes: int,
    rows: int,
    out_leaves: wp.array(dtype=wp.float32),
):
    slot = first + wp.tid()
    # Blocks of `lanes` slots side by side, `rows` numbers for each slot.
    start = slot / lanes * rows * lanes + slot % lanes
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
    if wp.length(rest) > FLAT * wp.length(b - a):
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
        put(out_leaves, start, k, lanes, a[k])
        put(out_leaves, start, 3 + k, lanes, x[k])
        put(out_leaves, start, 6 + k, lanes, y[k])
        put(out_leaves, start, 9 + k, lanes, z[k])
    put(out_leaves, start, 12, lanes, length)
    put(out_leaves, start, 13, lanes, cx)
    put(out_leaves, start, 14, lanes, cy)
    put(out_leaves, start, 15, lanes, reciprocal_or_zero(cx * cx + cy * cy))
    put(out_leaves, start, 16, lanes, reciprocal_or_zero((cx - length) * (cx - length) + cy * cy))


@wp.func_native(
    cpp(
        "core/simd.inl",
        "mesh/bvh/pack_ray_leaf_bvh8_cpu.inl",
        PLANE_ROWS=PLANE_ROWS,
        LEAF_WORDS=LEAF_WORDS,
        HEAD=HEAD,
        SLIVER=SLIVER,
        RAY_ERROR=RAY_ERROR,
        LEAST_QUANTUM=LEAST_QUANTUM,
    )
)
def pack_leaf(
    block: int,
    slot_triangle: wp.array(dtype=int),
    corners: wp.array(dtype=wp.vec3d),
    leaves: wp.array(dtype=wp.float32),
    origin: wp.vec3d,
    scale: wp.float64,
    out_leaves: wp.array(dtype=wp.float32),
): ...


@wp.kernel
def ray_leaves_kernel(
    first: int,
    slot_triangle: wp.array(dtype=int),
    corners: wp.array(dtype=wp.vec3d),
    leaves: wp.array(dtype=wp.float32),
    origin: wp.vec3d,
    scale: wp.float64,
    out_leaves: wp.array(dtype=wp.float32),
):
    """Pack the leaves into the form that rays read."""
    pack_leaf(first + wp.tid(), slot_triangle, corners, leaves, origin, scale, out_leaves)
