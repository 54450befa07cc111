"""Errors of interpolants at points of creases: each point counts for all cells around it."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.atomic_kernels import lower_to
from geokit.volume.adaptive.check_kernels import value_at

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


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
