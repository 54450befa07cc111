"""Greedy farthest point sampling over leaves and groups of leaves, each with a box and its farthest point.

The whole greedy loop runs in one launch: a launch for each selected point would cost more than its step. The loop
cannot be split among CPU threads or GPU blocks.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp

# The distance of a box never exceeds that of a point inside, rounding included, only if both are rounded term by term.
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# The C++ loop contains these numbers as literals: 64 points are a cache-friendly run and the bits of a mask.
LEAF_POINTS = wp.constant(64)
GROUP_LEAVES = wp.constant(64)
GROUP_POINTS = wp.constant(4096)
NO_POINT = wp.constant(2147483647)


@wp.struct
class SampledCloud:
    """Points in leaves of LEAF_POINTS and groups of GROUP_LEAVES leaves.

    ``squared`` is the squared distance of a point from the selected ones; -1 for selected points and for padding. Each
    leaf and group has its box (six consecutive arrays: lower x, y, z, upper x, y, z), the largest ``squared`` in it,
    and the position of the point with that value; among ties the point with the lowest index.
    """

    x: wp.array(dtype=wp.float64)
    y: wp.array(dtype=wp.float64)
    z: wp.array(dtype=wp.float64)
    squared: wp.array(dtype=wp.float64)
    index: wp.array(dtype=wp.int32)
    leaf_box: wp.array(dtype=wp.float64)
    leaf_far: wp.array(dtype=wp.float64)
    leaf_at: wp.array(dtype=wp.int32)
    group_box: wp.array(dtype=wp.float64)
    group_far: wp.array(dtype=wp.float64)
    group_at: wp.array(dtype=wp.int32)
    group_count: wp.int32


@wp.kernel
def gather_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    order: wp.array(dtype=wp.int32),
    scale: wp.float64,
    start: wp.int32,
    cloud: SampledCloud,
    out_start: wp.array(dtype=wp.int32),
):
    """Scaled points in order with padding at the end, and the position of the first point to select."""
    i = first + wp.tid()
    p = wp.vec3d()
    squared = wp.float64(-1.0)
    index = NO_POINT
    if i < points.shape[0]:
        index = order[i]
        p = points[index] * scale
        squared = wp.float64(wp.inf)
        if index == start:
            out_start[0] = i
    cloud.x[i] = p[0]
    cloud.y[i] = p[1]
    cloud.z[i] = p[2]
    cloud.squared[i] = squared
    cloud.index[i] = index


@wp.func
def put_box(box: wp.array(dtype=wp.float64), count: wp.int32, i: wp.int32, lower: wp.vec3d, upper: wp.vec3d):
    for axis in range(3):
        box[axis * count + i] = lower[axis]
        box[(3 + axis) * count + i] = upper[axis]


@wp.kernel
def leaf_box_kernel(first: int, cloud: SampledCloud, point_count: wp.int32):
    """Box of each leaf; an empty leaf is infinitely far from everything and offers no point."""
    i = first + wp.tid()
    lower = wp.vec3d(wp.float64(wp.inf))
    upper = -lower
    far = wp.float64(-1.0)
    at = wp.int32(-1)
    for k in range(i * LEAF_POINTS, wp.min((i + 1) * LEAF_POINTS, point_count)):
        p = wp.vec3d(cloud.x[k], cloud.y[k], cloud.z[k])
        lower = wp.min(lower, p)
        upper = wp.max(upper, p)
        far = wp.float64(wp.inf)
        at = k
    put_box(cloud.leaf_box, cloud.group_count * GROUP_LEAVES, i, lower, upper)
    cloud.leaf_far[i] = far
    cloud.leaf_at[i] = at


@wp.kernel
def group_box_kernel(first: int, cloud: SampledCloud):
    """Box of each group of leaves."""
    i = first + wp.tid()
    count = cloud.group_count * GROUP_LEAVES
    lower = wp.vec3d(wp.float64(wp.inf))
    upper = -lower
    far = wp.float64(-1.0)
    at = wp.int32(-1)
    for k in range(i * GROUP_LEAVES, (i + 1) * GROUP_LEAVES):
        for axis in range(3):
            lower[axis] = wp.min(lower[axis], cloud.leaf_box[axis * count + k])
            upper[axis] = wp.max(upper[axis], cloud.leaf_box[(3 + axis) * count + k])
        if cloud.leaf_at[k] >= 0:
            far = wp.float64(wp.inf)
            at = cloud.leaf_at[k]
    put_box(cloud.group_box, cloud.group_count, i, lower, upper)
    cloud.group_far[i] = far
    cloud.group_at[i] = at


@wp.kernel
@cpp.native_item("points/clouds/farthest_points.inl", "take_farthest", SampledCloud)
def greedy_kernel(first: int):
    """Select ``count`` points; all threads of the single block take part in every step."""
