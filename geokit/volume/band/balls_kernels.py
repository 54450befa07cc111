"""Distances to a union of balls, sorted into buckets: each row of voxels takes the minimum over the balls near it.

Coordinates are index coordinates in float64. A bucket is a cube at least as wide as the farthest voxel that one of its
balls may reach. So the balls that matter to a block lie in its bucket and the 26 around it, in nine runs along z.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp

vec8d = wp.types.vector(length=8, dtype=wp.float64)

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Runs of buckets around a block: 3 x 3 rows along z.
RUNS = wp.constant(9)
# A tile's list leaves out a ball if another is nearer to all of the tile's voxels by more than this [voxels]. Distances
# within 2^21 tiles round by less than 1e-8; a ball too many changes nothing.
SLACK = wp.constant(wp.float64(1.0e-8))

BITS = wp.constant(wp.uint64(21))  # of each bucket coordinate in a key

# States of a block.
AWAY = wp.constant(0)
NEAR = wp.constant(1)
INSIDE = wp.constant(2)


@wp.struct
class Balls:
    """Balls of similar size, sorted by bucket.

    ``keys`` are the ascending keys of the buckets that hold a ball; bucket ``b`` holds the balls ``start[b]`` to
    ``start[b + 1] - 1``. ``lower`` is the first bucket and ``width`` a bucket's edge [voxels]. ``center`` and
    ``radius`` hold the balls of all sizes; ``uniform`` is not 0 if all radii are equal.
    """

    center: wp.array(dtype=wp.vec3d)
    radius: wp.array(dtype=wp.float64)
    keys: wp.array(dtype=wp.int64)
    start: wp.array(dtype=wp.int32)
    lower: wp.vec3i
    width: int
    uniform: int


@wp.func
def floor_divide(a: int, b: int) -> int:
    q = a // b
    if q * b > a:
        q -= 1
    return q


@wp.func
def first_bucket(balls: Balls, x: int, y: int, z: int) -> int:
    """First bucket whose key is not below that of (x, y, z), else the bucket count."""
    key = wp.int64((((wp.uint64(x) << BITS) | wp.uint64(y)) << BITS) | wp.uint64(z))
    # Warp answers at most the place before the end that it is given, which it does not read.
    return wp.lower_bound(balls.keys, 0, balls.keys.shape[0] + 1, key)


@wp.func
def run_of(balls: Balls, corner: wp.vec3i, n: int) -> wp.vec2i:
    """First ball of run ``n`` around the bucket of a block, and one past its last ball."""
    x = floor_divide(corner[0], balls.width) - balls.lower[0] + n // 3 - 1
    y = floor_divide(corner[1], balls.width) - balls.lower[1] + n % 3 - 1
    z = floor_divide(corner[2], balls.width) - balls.lower[2]
    run = wp.vec2i(0, 0)
    if x >= 0 and y >= 0 and z >= -1:
        run = wp.vec2i(
            balls.start[first_bucket(balls, x, y, wp.max(z - 1, 0))], balls.start[first_bucket(balls, x, y, z + 2)]
        )
    return run


@wp.func
def nearest_to(center: wp.vec3d, low: wp.vec3d, high: wp.vec3d) -> wp.float64:
    """Distance of a point from a box."""
    squared = wp.float64(0.0)
    for axis in range(3):
        gap = wp.max(wp.max(low[axis] - center[axis], center[axis] - high[axis]), wp.float64(0.0))
        squared += gap * gap
    return wp.sqrt(squared)


@wp.func
def farthest_from(center: wp.vec3d, low: wp.vec3d, high: wp.vec3d) -> wp.float64:
    """Distance of a point from the farthest corner of a box."""
    squared = wp.float64(0.0)
    for axis in range(3):
        reach = wp.max(wp.abs(low[axis] - center[axis]), wp.abs(high[axis] - center[axis]))
        squared += reach * reach
    return wp.sqrt(squared)


@wp.func
def first_voxel(corner: wp.vec3i) -> wp.vec3d:
    return wp.vec3d(wp.float64(corner[0]), wp.float64(corner[1]), wp.float64(corner[2]))


@wp.func
def last_voxel(corner: wp.vec3i, size: int) -> wp.vec3d:
    return first_voxel(corner + wp.vec3i(size - 1, size - 1, size - 1))


@wp.kernel
def state_kernel(
    first: int,
    balls: Balls,
    corners: wp.array(dtype=wp.vec3i),
    size: int,
    band: wp.float64,
    out_state: wp.array(dtype=wp.int32),
):
    """State of a block (at most a bucket): all voxels away from the balls, some near, or all deep inside a ball."""
    i = first + wp.tid()
    low = first_voxel(corners[i])
    high = last_voxel(corners[i], size)
    state = int(AWAY)
    n = int(0)
    while n < RUNS and state != INSIDE:
        run = run_of(balls, corners[i], n)
        b = int(run[0])
        while b < run[1] and state != INSIDE:
            if nearest_to(balls.center[b], low, high) - balls.radius[b] < band + SLACK:
                state = int(NEAR)
                if farthest_from(balls.center[b], low, high) - balls.radius[b] <= -band:
                    state = int(INSIDE)
            b += 1
        n += 1
    out_state[i] = state


@wp.kernel
def bound_kernel(first: int, balls: Balls, corners: wp.array(dtype=wp.vec3i), out_bound: wp.array(dtype=wp.float64)):
    """Lowers ``out_bound`` to a distance that no voxel of a tile exceeds."""
    i = first + wp.tid()
    low = first_voxel(corners[i])
    high = last_voxel(corners[i], 8)
    bound = wp.float64(out_bound[i])
    for n in range(RUNS):
        run = run_of(balls, corners[i], n)
        for b in range(run[0], run[1]):
            bound = wp.min(bound, farthest_from(balls.center[b], low, high) - balls.radius[b])
    out_bound[i] = bound


@wp.func
def may_matter(balls: Balls, b: int, low: wp.vec3d, high: wp.vec3d, bound: wp.float64) -> bool:
    """Whether a ball may be the nearest to some voxel of a tile."""
    return nearest_to(balls.center[b], low, high) - balls.radius[b] <= bound + SLACK


@wp.kernel
def list_kernel(
    first: int,
    balls: Balls,
    corners: wp.array(dtype=wp.vec3i),
    bound: wp.array(dtype=wp.float64),
    band: wp.float64,
    out_place: wp.array(dtype=wp.int32),
    out_ball: wp.array(dtype=wp.int32),
):
    """Lists the balls that may matter to each tile from ``out_place`` on, which it advances to the end of the list.

    Without room in ``out_ball`` it only counts them. Tiles deep inside need none.
    """
    i = first + wp.tid()
    if bound[i] <= -band:
        return
    low = first_voxel(corners[i])
    high = last_voxel(corners[i], 8)
    place = int(out_place[i])
    for n in range(RUNS):
        run = run_of(balls, corners[i], n)
        for b in range(run[0], run[1]):
            if may_matter(balls, b, low, high, bound[i]):
                if out_ball.shape[0] > 0:
                    out_ball[place] = b
                place += 1
    out_place[i] = place


@wp.kernel
@cpp.native_item("volume/band/balls.inl", "least_distances", SLACK=float(SLACK))
def distance_kernel(first: int, balls: Balls, out_distance: wp.array2d(dtype=vec8d)):
    """Least distances of a row of eight voxels to the balls in its tile's list, at most the band; 64 rows to a tile."""
