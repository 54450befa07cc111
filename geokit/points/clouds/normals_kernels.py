"""Plane fits to neighborhoods of points: covariance, eigenvectors by Jacobi rotations, and signs from a viewpoint.

Sums are relative to the point itself, whose differences to nearby points are exact in float64, so that neither an
offset nor the scale of the points costs digits.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.points.search.cells_kernels import MASK_BITS, CellGrid
from geokit.points.search.neighbors_kernels import cells_around, lowest_bit, reach_of, row_count, row_range, within_mask

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Registers of a thread on a GPU; see docs/design/launches-and-memory.md.
REGISTERS = 96

# Number of sweeps. Rotations converge quadratically: off-diagonals of 1e-1, 1e-2, 1e-5, 1e-13 of the trace, then
# nothing. Twice as many are allowed.
MAX_SWEEPS = wp.constant(8)
# Off-diagonals below this share of the trace turn no eigenvector by more than earlier roundings did.
NEGLIGIBLE = wp.constant(wp.float64(2.0**-60))
# Neighborhoods whose squared width is below this share of their squared length are lines: eigenvalues are accurate to a
# few 2^-53 of the largest, so rounding would determine the normal.
LINE_RELATIVE = wp.constant(wp.float64(2.0**-46))
# Neighborhoods narrower than this many roundings of their coordinates, of half a step each, are lines too.
LINE_ROUNDINGS = wp.constant(wp.float64(4.0 * 2.0**-53))


@wp.struct
class Eigen:
    """Eigenvalues of a symmetric matrix and, under the same names, unit eigenvectors."""

    values: wp.vec3d
    x: wp.vec3d
    y: wp.vec3d
    z: wp.vec3d


@wp.func
def rotation_of(pp: wp.float64, qq: wp.float64, pq: wp.float64, least: wp.float64) -> wp.vec3d:
    """Cosine, sine and tangent of the smaller angle that zeroes the off-diagonal ``pq``, if it exceeds ``least``."""
    c = wp.float64(1.0)
    s = wp.float64(0.0)
    t = wp.float64(0.0)
    if wp.abs(pq) > least:
        theta = (qq - pp) / (wp.float64(2.0) * pq)
        t = wp.float64(1.0) / (wp.abs(theta) + wp.sqrt(theta * theta + wp.float64(1.0)))
        if theta < wp.float64(0.0):
            t = -t
        c = wp.float64(1.0) / wp.sqrt(t * t + wp.float64(1.0))
        s = t * c
    return wp.vec3d(c, s, t)


@wp.func
def rotated(
    pp: wp.float64,
    qq: wp.float64,
    pq: wp.float64,
    pr: wp.float64,
    qr: wp.float64,
    p: wp.vec3d,
    q: wp.vec3d,
    least: wp.float64,
):
    """One rotation: entries of rows p and q of a symmetric 3 x 3 matrix, and the eigenvectors p and q."""
    r = rotation_of(pp, qq, pq, least)
    off = pq
    if wp.abs(pq) > least:
        off = wp.float64(0.0)
    return (
        pp - r[2] * pq,
        qq + r[2] * pq,
        off,
        r[0] * pr - r[1] * qr,
        r[1] * pr + r[0] * qr,
        r[0] * p - r[1] * q,
        r[1] * p + r[0] * q,
    )


@wp.func
def eigen_of(m: wp.mat33d) -> Eigen:
    """Eigenvalues and eigenvectors of a symmetric matrix, unordered.

    Source: Golub, Van Loan, Matrix Computations (2013), 8.5, cyclic by rows. Eigenvalues are accurate to 1e-15 of the
    largest. Eigenvectors are orthonormal to 1e-15, each with an error of about 1e-15 of the largest eigenvalue over the
    gap to the others.
    """
    a = m[0, 0]
    b = m[1, 1]
    c = m[2, 2]
    ab = m[0, 1]
    ac = m[0, 2]
    bc = m[1, 2]
    x = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    y = wp.vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
    z = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    limit = (wp.abs(a) + wp.abs(b) + wp.abs(c)) * NEGLIGIBLE
    # Three off-diagonals below this are together below the limit.
    least = wp.float64(0.25) * limit
    sweep = wp.int32(0)
    while sweep < MAX_SWEEPS and wp.abs(ab) + wp.abs(ac) + wp.abs(bc) > limit:
        sweep += 1
        a, b, ab, ac, bc, x, y = rotated(a, b, ab, ac, bc, x, y, least)
        a, c, ac, ab, bc, x, z = rotated(a, c, ac, ab, bc, x, z, least)
        b, c, bc, ab, ac, y, z = rotated(b, c, bc, ab, ac, y, z, least)
    found = Eigen()
    found.values = wp.vec3d(a, b, c)
    found.x = x
    found.y = y
    found.z = z
    return found


@wp.func
def leading_up(n: wp.vec3d) -> wp.vec3d:
    """The one of n and -n whose component of largest magnitude is positive; among ties the first component decides."""
    largest = n[0]
    if wp.abs(n[1]) > wp.abs(largest):
        largest = n[1]
    if wp.abs(n[2]) > wp.abs(largest):
        largest = n[2]
    if largest < wp.float64(0.0):
        return -n
    return n


@wp.struct
class Plane:
    normal: wp.vec3d
    curvature: wp.float64


@wp.func
def plane_of(count: wp.int32, sums: wp.mat33d, rounding: wp.float64) -> Plane:
    """Normal and surface variation of ``count`` points from sums of their differences and of the products of these.

    ``sums`` holds (x, y, z), (xx, xy, xz), (yy, yz, zz). ``rounding`` bounds the rounding of the coordinates, in the
    units of the differences.
    """
    plane = Plane()
    if count < 3:
        return plane
    n = wp.float64(count)
    x = sums[0, 0] / n
    y = sums[0, 1] / n
    z = sums[0, 2] / n
    xy = sums[1, 1] / n - x * y
    xz = sums[1, 2] / n - x * z
    yz = sums[2, 1] / n - y * z
    xx = sums[1, 0] / n - x * x
    yy = sums[2, 0] / n - y * y
    zz = sums[2, 2] / n - z * z
    found = eigen_of(wp.mat33d(xx, xy, xz, xy, yy, yz, xz, yz, zz))
    e = found.values
    least = e[0]
    normal = found.x
    if e[1] < least:
        least = e[1]
        normal = found.y
    if e[2] < least:
        least = e[2]
        normal = found.z
    largest = wp.max(wp.max(e[0], e[1]), e[2])
    middle = (e[0] + e[1] + e[2]) - least - largest
    if middle <= largest * LINE_RELATIVE or middle <= rounding * rounding:
        return plane
    # Already orthonormal to a rounding; normalizing makes the length 1 to the last bit.
    plane.normal = leading_up(normal / wp.sqrt(wp.dot(normal, normal)))
    plane.curvature = wp.max(least, wp.float64(0.0)) / (e[0] + e[1] + e[2])
    return plane


@cpp.func_native("points/clouds/normals.inl")
def row_sums(neighbor: wp.array2d(dtype=wp.int32)) -> wp.mat33d:
    """Sums for plane_of over the differences of the first ``count`` neighbors in row i to point i."""
    ...


@wp.func
def largest_of(p: wp.vec3d) -> wp.float64:
    return wp.max(wp.max(wp.abs(p[0]), wp.abs(p[1])), wp.abs(p[2]))


@wp.kernel
def place_kernel(
    first: int,
    order: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3d),
    out_place: wp.array(dtype=wp.int32),
    out_points: wp.array(dtype=wp.vec3d),
):
    """Position of each point in the order, and the points in this order."""
    i = first + wp.tid()
    out_place[order[i]] = i
    out_points[i] = points[order[i]]


@wp.kernel
@cpp.native_item("points/clouds/normals.inl", "place_row")
def place_neighbors_kernel(first: int, neighbor: wp.array2d(dtype=wp.int32), out_neighbor: wp.array2d(dtype=wp.int32)):
    """Rows of neighbors in the order, as positions in it."""


@wp.kernel(cuda_max_registers=REGISTERS)
def nearest_plane_kernel(
    first: int,
    order: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3d),
    distance: wp.array(dtype=wp.float64, ndim=2),
    neighbor: wp.array(dtype=wp.int32, ndim=2),
    out_normal: wp.array(dtype=wp.vec3d),
    out_curvature: wp.array(dtype=wp.float64),
):
    """Plane of each row of neighbors, the nearest first. Points and neighbors are in the order, distances are not."""
    i = first + wp.tid()
    p = points[i]
    row = order[i]
    count = neighbor.shape[1]
    while count > 0 and neighbor[i, count - 1] < 0:
        count -= 1
    # Differences of at most unit size: their squares stay in range.
    farthest = distance[row, wp.max(count - 1, 0)]
    scale = wp.float64(0.0)
    if farthest > wp.float64(0.0):
        scale = wp.float64(1.0) / farthest
    sums = row_sums(points, neighbor, i, count, scale)
    plane = plane_of(count, sums, LINE_ROUNDINGS * ((largest_of(p) + farthest) * scale))
    out_normal[row] = plane.normal
    out_curvature[row] = plane.curvature


@wp.kernel(cuda_max_registers=REGISTERS)
def within_plane_kernel(
    first: int,
    grid: CellGrid,
    radius: wp.float64,
    scale: wp.float64,
    out_normal: wp.array(dtype=wp.vec3d),
    out_curvature: wp.array(dtype=wp.float64),
):
    """Plane of the points within the radius of each point; ``scale`` makes their differences at most one."""
    s = first + wp.tid()
    p = wp.vec3d(grid.x[s], grid.y[s], grid.z[s])
    box = cells_around(grid, p, reach_of(radius))
    sums = wp.mat33d()
    widest = wp.float64(0.0)
    count = wp.int32(0)
    for row in range(row_count(box)):
        span = row_range(grid, box, row)
        for begin in range(span[0], span[1], MASK_BITS):
            mask = within_mask(grid, begin, span[1], p, radius * radius)
            while mask != wp.uint64(0):
                j = begin + lowest_bit(mask)
                mask = mask & (mask - wp.uint64(1))
                x = (grid.x[j] - p[0]) * scale
                y = (grid.y[j] - p[1]) * scale
                z = (grid.z[j] - p[2]) * scale
                sums += wp.mat33d(x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)
                widest = wp.max(widest, largest_of(wp.vec3d(x, y, z)))
                count += 1
    plane = plane_of(count, sums, LINE_ROUNDINGS * (largest_of(p) * scale + widest))
    out_normal[grid.index[s]] = plane.normal
    out_curvature[grid.index[s]] = plane.curvature


@wp.kernel
def towards_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    viewpoint: wp.vec3d,
    out_normal: wp.array(dtype=wp.vec3d),
):
    """Flip normals that point away from the viewpoint."""
    i = first + wp.tid()
    if wp.dot(out_normal[i], viewpoint - points[i]) < wp.float64(0.0):
        out_normal[i] = -out_normal[i]
