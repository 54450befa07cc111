"""Errors of a cell's interpolant against the exact distance, in the part of the cell near the surface.

If q is the closest point of p on the surface, it is the closest point of every point on the segment from q to p. So one
query at p gives exact distances on the whole segment, and thus next to the surface, where they matter. A point of a
crease counts for all cells around it.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core.atomic_kernels import lower_to
from geokit.volume.sampling.sample_kernels import trilinear
from geokit.volume.sampling.stencil_kernels import Cubic, Quadratic, weights

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# Test points on a segment, from the surface to the zone's edge, both included.
PLACES = wp.constant(4)
# Weight of creases outside the cell, which its interpolant sees from order 2 on: there the weights are small.
BESIDE = wp.constant(wp.float64(0.4))
# Share of a voxel by which rounding may put a position on the border outside its cell.
SLACK = wp.constant(wp.float64(1e-9))


@wp.func
def outside_cell(f: wp.vec3d) -> bool:
    return wp.min(f) < -SLACK or wp.max(f) > wp.float64(1.0) + SLACK


@wp.func
def voxel_of(rows: wp.array2d(dtype=int), distance: wp.array(dtype=wp.float64), n: int, row: int, k: int) -> wp.float64:
    """A voxel of the stencil of cell n as a grid stores it."""
    return wp.float64(wp.float32(distance[rows[n, row] + k]))


@wp.func
def axis_weights(order: int, t: wp.float64) -> wp.vec4d:
    if order == 2:
        return weights(Quadratic(), t)[0]
    return weights(Cubic(), t)[0]


@wp.func
def value_at(
    rows: wp.array2d(dtype=int), distance: wp.array(dtype=wp.float64), n: int, order: int, f: wp.vec3d
) -> wp.float64:
    """The interpolant of cell n at fractions f."""
    if order == 1:
        return trilinear(
            voxel_of(rows, distance, n, 0, 0),
            voxel_of(rows, distance, n, 0, 1),
            voxel_of(rows, distance, n, 1, 0),
            voxel_of(rows, distance, n, 1, 1),
            voxel_of(rows, distance, n, 2, 0),
            voxel_of(rows, distance, n, 2, 1),
            voxel_of(rows, distance, n, 3, 0),
            voxel_of(rows, distance, n, 3, 1),
            f,
        )
    width = order + 1
    x = axis_weights(order, f[0])
    y = axis_weights(order, f[1])
    z = axis_weights(order, f[2])
    total = wp.float64(0.0)
    for i in range(width):
        for j in range(width):
            along = wp.float64(0.0)
            for k in range(width):
                along += z[k] * voxel_of(rows, distance, n, i * width + j, k)
            total += x[i] * y[j] * along
    return total


@wp.func
def error_along(
    p: wp.vec3d,
    q: wp.vec3d,
    d: wp.float64,
    base: wp.vec3d,
    size: wp.float64,
    within: wp.float64,
    rows: wp.array2d(dtype=int),
    distance: wp.array(dtype=wp.float64),
    n: int,
    order: int,
) -> wp.float64:
    """Largest error on the part of the segment from q to p that lies in cell n and in the zone."""
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
            worst = wp.max(worst, wp.abs(value_at(rows, distance, n, order, f) - exact))
    return worst


@wp.func
def corner_position(base: wp.vec3d, size: wp.float64, k: int) -> wp.vec3d:
    return base + size * wp.vec3d(wp.float64(k / 4), wp.float64(k / 2 % 2), wp.float64(k % 2))


@wp.kernel
def examine_kernel(
    first: int,
    cells: wp.array(dtype=wp.vec3i),
    rows: wp.array2d(dtype=int),
    order: int,
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
    p = base + wp.vec3d(wp.float64(0.5) * size)
    d = center_distance[n]
    worst = error_along(p, center_closest[n], d, base, size, within, rows, distance, n, order)
    # A center on the surface has no direction; the voxels' directions are then compared with each other.
    known = wp.abs(d) > SLACK * size
    middle = wp.vec3d()
    if known:
        middle = (p - center_closest[n]) / d
    spread = wp.float64(0.0)
    # The cell's own voxels; from order 2 on, a stencil begins one voxel before them.
    width = order + 1
    before = wp.min(order - 1, 1)
    for k in range(8):
        v = rows[n, (k / 4 + before) * width + k / 2 % 2 + before] + k % 2 + before
        p = corner_position(base, size, k)
        d = distance[v]
        worst = wp.max(worst, error_along(p, closest[v], d, base, size, within, rows, distance, n, order))
        if wp.abs(d) > SLACK * size:
            direction = (p - closest[v]) / d
            if not known:
                known = True
                middle = direction
            spread = wp.max(spread, wp.length(direction - middle))
    if order > 1:
        for i in range(width):
            for j in range(width):
                for k in range(width):
                    v = rows[n, width * i + j] + k
                    p = base + size * wp.vec3d(wp.float64(i - 1), wp.float64(j - 1), wp.float64(k - 1))
                    d = distance[v]
                    if known and wp.abs(d) > SLACK * size:
                        spread = wp.max(spread, BESIDE * wp.length((p - closest[v]) / d - middle))
    out_error[n] = worst
    out_spread[n] = spread


@wp.kernel
def inspect_kernel(
    first: int,
    cells: wp.array(dtype=wp.vec3i),
    rows: wp.array2d(dtype=int),
    order: int,
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
    worst = wp.float64(0.0)
    for k in range(count):
        i = count * n + k
        worst = wp.max(
            worst,
            error_along(points[i], point_closest[i], point_distance[i], base, size, within, rows, distance, n, order),
        )
    out_error[n] = worst


@wp.func
def is_beside(u: wp.float64, border: wp.float64) -> bool:
    return wp.abs(u - wp.rint(u)) < border


@wp.func
def first_cell(u: wp.float64, border: wp.float64) -> wp.float64:
    """The cell that begins at a border beside u, or that holds u."""
    return wp.where(is_beside(u, border), wp.rint(u), wp.floor(u))


@wp.func
def cell_around(u: wp.vec3d, border: wp.float64, k: int) -> wp.vec3d:
    """The k-th of the eight cells that may hold u; its first coordinate is negative if that does not reach u."""
    back = wp.vec3i(k / 4, k / 2 % 2, k % 2)
    cell = wp.vec3d()
    for axis in range(3):
        if back[axis] == 1 and not is_beside(u[axis], border):
            return wp.vec3d(wp.float64(-1.0))
        cell[axis] = first_cell(u[axis], border) - wp.float64(back[axis])
    return cell


@wp.func
def row_of(keys: wp.array(dtype=wp.int64), rows: wp.array(dtype=int), cell: wp.vec3d) -> int:
    """The row of a cell, or -1."""
    # Keys hold coordinates of 21 bits that are not negative.
    if wp.min(cell) < wp.float64(0.0) or wp.max(cell) > wp.float64(2097151.0):
        return -1
    key = (wp.int64(cell[0]) << wp.int64(42)) | (wp.int64(cell[1]) << wp.int64(21)) | wp.int64(cell[2])
    at = wp.lower_bound(keys, key)
    if at < keys.shape[0] and keys[at] == key:
        return rows[at]
    return -1


@wp.kernel
def touched_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    keys: wp.array(dtype=wp.int64),
    rows: wp.array(dtype=int),
    worst: wp.array(dtype=wp.int64),
    most: wp.int64,
    origin: wp.vec3d,
    size: wp.float64,
    border: wp.float64,
    out_touched: wp.array(dtype=wp.uint8),
):
    """Whether a point lies in a cell, or up to ``border`` beside one, whose error does not exceed the limit yet."""
    i = first + wp.tid()
    u = (points[i] - origin) / size
    touched = wp.uint8(0)
    for k in range(8):
        row = row_of(keys, rows, cell_around(u, border, k))
        if row >= 0 and worst[row] >= most:
            touched = wp.uint8(1)
    out_touched[i] = touched


@wp.kernel
def crease_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    exact: wp.array(dtype=wp.float64),
    keys: wp.array(dtype=wp.int64),
    rows: wp.array(dtype=int),
    before: wp.array(dtype=wp.int64),
    most: wp.int64,
    stencils: wp.array2d(dtype=int),
    order: int,
    distance: wp.array(dtype=wp.float64),
    origin: wp.vec3d,
    size: wp.float64,
    border: wp.float64,
    reach: wp.float64,
    out_worst: wp.array(dtype=wp.int64),
):
    """Largest error of each cell: its bits, negative. Errors of cells that ``before`` exceed the limit are left out.

    Bits of floats that are not negative have the order of the floats.
    """
    i = first + wp.tid()
    if wp.abs(exact[i]) > reach:
        return
    u = (points[i] - origin) / size
    for k in range(8):
        cell = cell_around(u, border, k)
        row = row_of(keys, rows, cell)
        if row >= 0 and before[row] >= most:
            error = wp.abs(value_at(stencils, distance, row, order, u - cell) - exact[i])
            lower_to(out_worst, row, -wp.cast(error, wp.int64))
