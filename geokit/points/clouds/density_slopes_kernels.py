"""Derivatives of densities by the distances to the points that they sum over."""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core.gradients.sums_kernels import overloads
from geokit.points.clouds.density_kernels import CubicSpline, Poly6, WendlandC2

# Without fused multiply-adds a GPU gives the same bits as a CPU.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

PI = wp.constant(wp.float64(wp.PI))


@wp.func
def slope(kernel: CubicSpline, q: wp.float64) -> wp.float64:
    """Of W * radius^3 by the share q of the radius."""
    rest = wp.max(wp.float64(1.0) - q, wp.float64(0.0))
    result = wp.float64(-6.0) * rest * rest
    if q <= wp.float64(0.5):
        result = (wp.float64(18.0) * q - wp.float64(12.0)) * q
    return wp.float64(8.0) / PI * result


@wp.func
def slope(kernel: WendlandC2, q: wp.float64) -> wp.float64:  # noqa: F811
    rest = wp.max(wp.float64(1.0) - q, wp.float64(0.0))
    return wp.float64(-210.0) / PI * q * rest * rest * rest


@wp.func
def slope(kernel: Poly6, q: wp.float64) -> wp.float64:  # noqa: F811
    rest = wp.max(wp.float64(1.0) - q * q, wp.float64(0.0))
    return wp.float64(-945.0 / 32.0) / PI * q * rest * rest


@wp.kernel
def density_slopes_kernel(
    first: int,
    offsets: wp.array(dtype=wp.int64),
    indices: wp.array(dtype=int),
    distance: wp.array(dtype=Any),
    mass: wp.array(dtype=wp.float64),
    smoothing: Any,
    by_density: wp.array(dtype=Any),
    out_by_distance: wp.array(dtype=Any),
):
    """The slope of each distance of a query, from that of its density."""
    i = first + wp.tid()
    share = smoothing.inverse_radius
    square = share * share
    factor = wp.float64(by_density[i]) * (square * square)
    for pair in range(int(offsets[i]), int(offsets[i + 1])):
        # There is one mass for all points, or one for each.
        weight = mass[wp.min(indices[pair], mass.shape[0] - 1)]
        found = factor * weight * slope(smoothing, wp.float64(distance[pair]) * share)
        out_by_distance[pair] = type(distance[pair])(found)


SMOOTHING = {"cubic_spline": CubicSpline, "wendland_c2": WendlandC2, "poly6": Poly6}
# By the kernel, and by the type of the queries' coordinates.
DENSITY_SLOPES = {
    name: overloads(density_slopes_kernel, (), ("distance", "by_density", "out_by_distance"), smoothing=kind)
    for name, kind in SMOOTHING.items()
}
