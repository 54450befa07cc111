"""Neighbors of a query, read from x-rows of cells.

Every comparison uses the caller's float64 coordinates with explicit roundings, so that the result is the one that
``(dx * dx + dy * dy) + dz * dz <= radius * radius`` gives on any other machine.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.points.search.cells_kernels import CellGrid, cell_along, cell_key

# Fused multiply-adds would round the squared distance once instead of five times: the compiler would decide whether
# points at exactly the radius are in or out.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


# The coordinate of a neighbor may differ from the query's by slightly more than the radius without its rounded squared
# distance exceeding the rounded squared radius: each of these roundings is at most 1.2e-16 relative.
REACH_RELATIVE = wp.constant(wp.float64(1.0e-15))
# Squares below 4.9e-324 round to 0: coordinates up to 2.3e-162 apart count as equal for every radius.
REACH_ABSOLUTE = wp.constant(wp.float64(1.0e-161))


@wp.struct
class CellBox:
    """Cells that intersect a query's cube, both corners inclusive; empty if an upper corner is below the lower one."""

    lower: wp.vec3i
    upper: wp.vec3i


@wp.func
def cells_around(grid: CellGrid, q: wp.vec3d, reach: wp.float64) -> CellBox:
    """Cells that intersect the cube of half edge ``reach`` around ``q``."""
    box = CellBox()
    for axis in range(3):
        low = q[axis] - reach
        high = q[axis] + reach
        box.lower[axis] = cell_along(grid, axis, low)
        box.upper[axis] = cell_along(grid, axis, high)
        # Clamping alone would make a far query read the cells at the border.
        if high < grid.lower[axis] or low > grid.upper[axis]:
            box.upper[axis] = -1
    return box


@wp.func
def first_at_or_above(grid: CellGrid, key: wp.int64) -> wp.int32:
    """First sorted point whose key is not below ``key``."""
    bucket = wp.int32(key >> wp.int64(grid.shift))
    begin = grid.start[bucket]
    # A key at the start of its bucket needs no search; with shift 0 every key is.
    if (key & ((wp.int64(1) << wp.int64(grid.shift)) - wp.int64(1))) != wp.int64(0):
        begin = wp.lower_bound(grid.key, begin, grid.start[bucket + 1] + 1, key)
    return begin


@wp.func
def row_count(box: CellBox) -> wp.int32:
    """Number of x-rows of cells in the box."""
    rows = wp.int32(0)
    if box.lower[0] <= box.upper[0] and box.lower[1] <= box.upper[1] and box.lower[2] <= box.upper[2]:
        rows = (box.upper[1] - box.lower[1] + 1) * (box.upper[2] - box.lower[2] + 1)
    return rows


@wp.func
def row_range(grid: CellGrid, box: CellBox, row: wp.int32) -> wp.vec2i:
    """Begin and end of the sorted points in one x-row of the box; neighbors in x are adjacent in memory."""
    width = box.upper[1] - box.lower[1] + 1
    y = box.lower[1] + row % width
    z = box.lower[2] + row // width
    begin = first_at_or_above(grid, cell_key(grid, box.lower[0], y, z))
    end = first_at_or_above(grid, cell_key(grid, box.upper[0] + 1, y, z))
    return wp.vec2i(begin, end)


@cpp.func_native("points/search/near.inl")
def within_mask(grid: CellGrid, begin: wp.int32, end: wp.int32, q: wp.vec3d, radius_squared: wp.float64) -> wp.uint64:
    """Bit mask: bit k is set if the sorted point ``begin + k`` is within the radius; at most MASK_BITS points."""
    ...


# warp 1.19 has no such built-in.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffsll((long long)mask) - 1;
#else
    return __builtin_ctzll(mask);
#endif
""")
def lowest_bit(mask: wp.uint64) -> wp.int32: ...


@wp.struct
class Queries:
    """Positions of queries in processing order, the row of each result, and the group if there are any."""

    x: wp.array(dtype=wp.float64)
    y: wp.array(dtype=wp.float64)
    z: wp.array(dtype=wp.float64)
    index: wp.array(dtype=wp.int32)
    group: wp.array(dtype=wp.int32)


@wp.struct
class Nearness:
    """A query in the grid's float32 frame, and the squared distances beyond which float32 decides.

    A point at a squared distance of at most ``surely`` is within the radius, one above ``possibly`` is not; float64
    decides between the two.
    """

    x: wp.float32
    y: wp.float32
    z: wp.float32
    surely: wp.float32
    possibly: wp.float32


# Unit roundoff u of float32: half the distance between 1 and the next float32.
ROUNDING = wp.constant(wp.float64(2.0**-24))
# The limits are themselves computed and rounded in float32: two steps outwards cover both errors.
OUTWARDS = wp.constant(wp.float64(2.0**-22))
# Beyond this size of local coordinates and radii float64 decides everything, as float32 squares overflow at 3.4e38.
LARGEST_LOCAL = wp.constant(wp.float64(1.0e15))
# Float32 squares vanish near 1e-38: smaller squares decide nothing.
SMALLEST_SQUARE = wp.constant(wp.float64(1.0e-30))
NO_LIMIT = wp.constant(wp.float32(wp.inf))


@wp.func
def nearness_of(grid: CellGrid, q: wp.vec3d, radius: wp.float64) -> Nearness:
    """The query in the float32 frame, with the range of distances that float32 cannot decide.

    A local coordinate has an error of u |x|, a difference of two one of 2 u m, with m the largest coordinate of q and
    of the points within its radius. The square, the sum and their roundings add at most 8 u of the result.
    """
    local = (q - grid.center) * grid.scale
    reach = radius * grid.scale
    largest = wp.max(wp.max(wp.abs(local[0]), wp.abs(local[1])), wp.abs(local[2])) + reach
    near = Nearness()
    near.x = wp.float32(local[0])
    near.y = wp.float32(local[1])
    near.z = wp.float32(local[2])
    near.surely = wp.float32(-1.0)
    near.possibly = NO_LIMIT
    if largest < LARGEST_LOCAL:
        shift = wp.float64(2.0) * ROUNDING * largest
        square = reach * reach
        doubt = wp.float64(4.0) * shift * (reach + shift) + wp.float64(8.0) * ROUNDING * square
        least = (square - doubt) * (wp.float64(1.0) - OUTWARDS)
        if least >= SMALLEST_SQUARE:
            near.surely = wp.float32(least)
        near.possibly = wp.float32(wp.max((square + doubt) * (wp.float64(1.0) + OUTWARDS), SMALLEST_SQUARE))
    return near


@cpp.func_native("points/search/near.inl")
def near_count(grid: CellGrid, near: Nearness) -> wp.int32:
    """Number of the sorted points ``begin .. end - 1`` whose squared distance from q is at most ``limit``."""
    ...


@cpp.func_native("points/search/near.inl")
def near_mask(grid: CellGrid, near: Nearness) -> wp.uint64:
    """The bit mask of :func:`within_mask`, with float64 used only for points that float32 cannot decide."""
    ...


@wp.func
def reach_of(radius: wp.float64) -> wp.float64:
    """Half edge of the cube that contains every neighbor, rounding included."""
    return radius * (wp.float64(1.0) + REACH_RELATIVE) + REACH_ABSOLUTE
