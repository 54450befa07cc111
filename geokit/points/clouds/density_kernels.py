"""Densities: a smoothing kernel summed over the rows of cells around a query.

Each smoothing kernel is a struct with the constants of one radius and an overload of ``weight``.
"""

# mypy: ignore-errors
from typing import Any

import warp as wp

from geokit.points.search.cells_kernels import MASK_BITS, CellGrid
from geokit.points.search.neighbors_kernels import (
    Queries,
    cells_around,
    lowest_bit,
    reach_of,
    row_count,
    row_range,
    within_mask,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})


@wp.struct
class Count:
    """1 within the radius."""

    inverse_radius: wp.float64


@wp.struct
class CubicSpline:
    """The cubic B-spline of Monaghan and Lattanzio, 1 at the center."""

    inverse_radius: wp.float64


@wp.struct
class WendlandC2:
    """Wendland's function with two continuous derivatives in three dimensions, 1 at the center."""

    inverse_radius: wp.float64


@wp.struct
class Poly6:
    """The kernel of Mueller, Charypar and Gross, 1 at the center."""

    inverse_radius: wp.float64


@wp.func
def weight(kernel: Count, squared: wp.float64) -> wp.float64:
    return wp.float64(1.0)


@wp.func
def weight(kernel: CubicSpline, squared: wp.float64) -> wp.float64:  # noqa: F811
    q = wp.sqrt(squared) * kernel.inverse_radius
    outer = wp.max(wp.float64(1.0) - q, wp.float64(0.0))
    result = wp.float64(2.0) * outer * outer * outer
    if q <= wp.float64(0.5):
        result = wp.float64(1.0) - wp.float64(6.0) * q * q * outer
    return result


@wp.func
def weight(kernel: WendlandC2, squared: wp.float64) -> wp.float64:  # noqa: F811
    q = wp.sqrt(squared) * kernel.inverse_radius
    outer = wp.max(wp.float64(1.0) - q, wp.float64(0.0))
    square = outer * outer
    return square * square * (wp.float64(1.0) + wp.float64(4.0) * q)


@wp.func
def weight(kernel: Poly6, squared: wp.float64) -> wp.float64:  # noqa: F811
    q = wp.sqrt(squared) * kernel.inverse_radius
    outer = wp.max(wp.float64(1.0) - q * q, wp.float64(0.0))
    return outer * outer * outer


@wp.kernel
def density_kernel(
    first: int,
    queries: Queries,
    grid: CellGrid,
    radius: wp.float64,
    smoothing: Any,
    factor: wp.float64,
    mass: wp.array(dtype=wp.float64),
    out_density: wp.array(dtype=wp.float64),
):
    """``factor`` times the sum of mass times weight of the points within the radius, in the order of the cells."""
    k = first + wp.tid()
    q = wp.vec3d(queries.x[k], queries.y[k], queries.z[k])
    box = cells_around(grid, q, reach_of(radius))
    last = mass.shape[0] - 1
    total = wp.float64(0.0)
    for row in range(row_count(box)):
        span = row_range(grid, box, row)
        for begin in range(span[0], span[1], MASK_BITS):
            mask = within_mask(grid, begin, span[1], q, radius * radius)
            while mask != wp.uint64(0):
                j = begin + lowest_bit(mask)
                mask = mask & (mask - wp.uint64(1))
                dx = grid.x[j] - q[0]
                dy = grid.y[j] - q[1]
                dz = grid.z[j] - q[2]
                # There is one mass for all points, or one for each.
                total += mass[wp.min(grid.index[j], last)] * weight(smoothing, (dx * dx + dy * dy) + dz * dz)
    out_density[queries.index[k]] = factor * total


for _smoothing in (Count, CubicSpline, WendlandC2, Poly6):
    wp.overload(density_kernel, {"smoothing": _smoothing})
