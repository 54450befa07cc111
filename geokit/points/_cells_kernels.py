"""Points sorted by the cells of a grid: the arrays that neighbour searches read, and the kernels that fill them.

Coordinates stay float64 and nothing here is hashed.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Points read together by one call of within_mask: one bit of a 64-bit mask for each. The coordinates are padded by as
# many entries, because vectors of eight read past the end of the last row.
MASK_BITS = wp.constant(64)

# Table entries filled by one item of table_kernel: one search serves the whole run.
TABLE_RUN = wp.constant(64)

# Points reduced by one item of bounds_kernel.
BOUNDS_RUN = wp.constant(1024)


@wp.struct
class CellGrid:
    """Points sorted by cell, and where each cell begins.

    Each axis is cut into intervals of equal cells: interval i begins at ``knot[i]`` with cell ``first_cell[i]`` and has
    ``cell_count[i]`` cells of ``1 / inverse_edge[i]``. ``first_knot`` and ``last_knot`` are an axis's own intervals.

    A point's key is ``(z * count_y + y) * count_x + x`` of its cell. ``start[b]`` is the first sorted point whose key
    is at least ``b << shift``; a finer boundary is searched between two entries.
    """

    x: wp.array(dtype=wp.float64)
    y: wp.array(dtype=wp.float64)
    z: wp.array(dtype=wp.float64)
    index: wp.array(dtype=wp.int32)
    key: wp.array(dtype=wp.int64)
    start: wp.array(dtype=wp.int32)
    knot: wp.array(dtype=wp.float64)
    inverse_edge: wp.array(dtype=wp.float64)
    first_cell: wp.array(dtype=wp.int32)
    cell_count: wp.array(dtype=wp.int32)
    first_knot: wp.vec3i
    last_knot: wp.vec3i
    lower: wp.vec3d
    upper: wp.vec3d
    count_x: wp.int32
    count_y: wp.int32
    shift: wp.int32


@wp.func
def cell_along(grid: CellGrid, axis: wp.int32, x: wp.float64) -> wp.int32:
    """Cell of a coordinate on one axis, clamped to the grid.

    The search, the subtraction, the product, the clamp and the truncation are all monotone, rounding included: a
    coordinate between two others gets a cell between theirs. This is all that the exactness of a search needs from
    the cells, whatever their sizes.
    """
    i = grid.first_knot[axis]
    last = grid.last_knot[axis]
    while i < last:
        middle = (i + last + 1) // 2
        if grid.knot[middle] <= x:
            i = middle
        else:
            last = middle - 1
    # Clamped as a float: an int cast of a far-away coordinate would be undefined.
    top = wp.float64(grid.cell_count[i] - 1)
    return grid.first_cell[i] + wp.int32(wp.clamp((x - grid.knot[i]) * grid.inverse_edge[i], wp.float64(0.0), top))


@wp.func
def cell_key(grid: CellGrid, x: wp.int32, y: wp.int32, z: wp.int32) -> wp.int64:
    return (wp.int64(z) * wp.int64(grid.count_y) + wp.int64(y)) * wp.int64(grid.count_x) + wp.int64(x)


@wp.kernel
def bounds_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    out_lower: wp.array(dtype=wp.vec3d),
    out_upper: wp.array(dtype=wp.vec3d),
):
    """Box around each run of BOUNDS_RUN points."""
    i = first + wp.tid()
    begin = i * BOUNDS_RUN
    lower = points[begin]
    upper = points[begin]
    for j in range(begin, wp.min(begin + BOUNDS_RUN, points.shape[0])):
        lower = wp.min(lower, points[j])
        upper = wp.max(upper, points[j])
    out_lower[i] = lower
    out_upper[i] = upper


@wp.kernel
def sample_kernel(first: int, points: wp.array(dtype=wp.vec3d), count: wp.int32, out_points: wp.array(dtype=wp.vec3d)):
    """``count`` of the points, evenly over their order."""
    i = first + wp.tid()
    out_points[i] = points[wp.int32(wp.int64(i) * wp.int64(points.shape[0]) // wp.int64(count))]


@wp.kernel
def key_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    grid: CellGrid,
    out_key: wp.array(dtype=wp.int64),
    out_index: wp.array(dtype=wp.int32),
):
    """Cell key of each point."""
    i = first + wp.tid()
    p = points[i]
    out_key[i] = cell_key(grid, cell_along(grid, 0, p[0]), cell_along(grid, 1, p[1]), cell_along(grid, 2, p[2]))
    out_index[i] = i


@wp.kernel
def gather_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=wp.int32),
    out_x: wp.array(dtype=wp.float64),
    out_y: wp.array(dtype=wp.float64),
    out_z: wp.array(dtype=wp.float64),
):
    """Coordinates in sorted order, one array for each axis."""
    i = first + wp.tid()
    p = points[index[i]]
    out_x[i] = p[0]
    out_y[i] = p[1]
    out_z[i] = p[2]


@wp.kernel
def table_kernel(
    first: int,
    key: wp.array(dtype=wp.int64),
    count: wp.int32,
    shift: wp.int32,
    out_start: wp.array(dtype=wp.int32),
):
    """A run of TABLE_RUN table entries: the first sorted point whose key is at least ``entry << shift``."""
    entry = (first + wp.tid()) * TABLE_RUN
    at = wp.int32(0)
    for b in range(entry, wp.min(entry + TABLE_RUN, out_start.shape[0])):
        bound = wp.int64(b) << wp.int64(shift)
        # Most entries of a sparse table begin where the one before does: no search for them.
        if at < count and key[at] < bound:
            end = count
            while at < end:
                middle = at + (end - at) // 2
                if key[middle] < bound:
                    at = middle + 1
                else:
                    end = middle
        out_start[b] = at


@wp.kernel
def unsort_kernel(first: int, grid: CellGrid, out_points: wp.array(dtype=wp.vec3d)):
    """The points in the order in which they came."""
    i = first + wp.tid()
    out_points[grid.index[i]] = wp.vec3d(grid.x[i], grid.y[i], grid.z[i])


@wp.kernel
def unsort_single_kernel(first: int, grid: CellGrid, out_points: wp.array(dtype=wp.vec3f)):
    """The points in the order in which they came, as float32."""
    i = first + wp.tid()
    out_points[grid.index[i]] = wp.vec3f(wp.float32(grid.x[i]), wp.float32(grid.y[i]), wp.float32(grid.z[i]))
