"""Density of points by a sum of smoothing kernels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.interop.types import Array, Device, Rows
from geokit.core.interop.user_arrays import read_numbers, require_finite_scalar
from geokit.core.memory.needs import rows
from geokit.core.query.ask import query
from geokit.core.require import require_choice
from geokit.errors import InputError
from geokit.points.neighbors.neighbor_grid import NeighborGrid

# Factor that makes the integral over space 1 at radius 1, and the name of the kernel's struct.
KERNELS = {
    "count": (3.0 / (4.0 * math.pi), "Count"),
    "cubic_spline": (8.0 / math.pi, "CubicSpline"),
    "wendland_c2": (21.0 / (2.0 * math.pi), "WendlandC2"),
    "poly6": (315.0 / (64.0 * math.pi), "Poly6"),
}


@query(inputs=("points", "queries"), gradient=".clouds.gradients:DENSITY", memory=lambda points, **_: 48 * rows(points))
def density(
    points: Rows,
    *,
    radius: float,
    kernel: str = "count",
    mass: Rows = 1.0,
    queries: Rows | None = None,
    device: Device = None,
) -> Array:
    """Mass density of the points at the queries.

    The density is the sum of ``mass[j] * W(|points[j] - query|)`` over all points within the radius. A query that is
    itself one of the points counts that point too. With q the distance divided by the radius, W * radius^3 is

    - "count": 3 / (4 pi) for q <= 1: the number of points within the radius divided by the volume of the ball;
    - "cubic_spline": 8 / pi * (1 - 6 q^2 + 6 q^3) for q <= 1/2, 8 / pi * 2 (1 - q)^3 above;
    - "wendland_c2": 21 / (2 pi) * (1 - q)^4 (1 + 4 q);
    - "poly6": 315 / (64 pi) * (1 - q^2)^3.

    All kernels are 0 beyond the radius, and the last three at the radius. ``radius`` is the support, which for the
    spline is twice the smoothing length h of many texts. Each kernel integrates to 1 over space.

    Error: a relative (n + 20) * 2^-53, with n the number of neighbors, for masses of one sign. The set of points within
    the radius is exact (:class:`NeighborGrid`). Sums run in the order of the cells, so they do not depend on the number
    of threads or on the order of the queries.

    On a lattice a radius of 2 spacings gives the density to 2 % (cubic_spline), 5 % (poly6), 8 % (wendland_c2) and 50 %
    (count). For random points the scatter at 3 spacings is 21, 18, 23 and 10 % rms.

    Args:
        points: Positions [world], shape (N, 3), float32 or float64.
        radius: Support of the kernel [world], greater than 0.
        kernel: "count", "cubic_spline", "wendland_c2" or "poly6".
        mass: Mass of a point: one number for all points, or one for each, shape (N,).
        queries: Positions [world], shape (Q, 3); None for the points themselves.
        device: Where to compute: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Returns:
        Densities (Q,) [mass / world^3], in the container of the queries, float32 for float32 queries.
    Raises:
        InputError: points or queries is not (N, 3) or not finite; radius is not a finite number greater than 0, or 1 /
            radius^3 overflows or underflows; kernel is not known; mass is not finite, or not one or N numbers; there is
            no such device.
    Source:
        Monaghan, Lattanzio, A refined particle method for astrophysical problems (1985): cubic spline. Wendland,
        Piecewise polynomial, positive definite and compactly supported radial functions (1995), normalized as by
        Dehnen, Aly, Improving convergence in smoothed particle hydrodynamics (2012). Mueller, Charypar, Gross,
        Particle-based fluid simulation for interactive applications (2003): poly6.
    Example:
        >>> around = gk.points.density([[0, 0, 0], [1, 0, 0]], radius=2.0, mass=8 * np.pi / 3, device="cpu")
        >>> around.round(12).tolist()
        [0.5, 0.5]
    """
    from geokit.points.clouds import density_kernels as kernels

    require_choice(kernel, "kernel", KERNELS)
    radius = require_finite_scalar(radius, "radius", low=0.0)
    volume = radius * radius * radius
    factor = KERNELS[kernel][0] / volume if volume > 0.0 else math.inf
    # At either end of the float64 range the result loses some or all of its digits.
    if not (np.finfo(np.float64).tiny < factor < np.inf):
        raise InputError(f"radius: {radius:g} has a volume that float64 cannot divide by; scale points and radius")
    target = launcher.resolve_device(device)
    neighbors = NeighborGrid(points, radius, device=target)
    masses = wp.array(_require_masses(mass, len(neighbors)), dtype=wp.float64, device=target)
    asked, home = neighbors._ask(queries, None, False)
    smoothing = getattr(kernels, KERNELS[kernel][1])()
    smoothing.inverse_radius = wp.float64(1.0 / radius)
    result = wp.empty(asked.count, dtype=wp.float64, device=target)
    for grid, arranged, number in asked.parts:
        given = [arranged, grid, wp.float64(radius), smoothing, wp.float64(factor), masses]
        launcher.launch(kernels.density_kernel, number, given, [result], target)
    return home.to_caller(result)


def _require_masses(mass: Any, count: int) -> np.ndarray:
    values = read_numbers(mass, "mass")
    if values.ndim == 0:
        return np.array([require_finite_scalar(values, "mass")])
    if values.shape != (count,):
        raise InputError(f"mass: shape {values.shape} is not one number, nor one for each of the {count} points")
    bad = ~np.isfinite(values)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"mass: row {row} is {values[row]}; give finite numbers")
    # A kernel cannot index an empty array; without points no mass is read.
    return values if count else np.ones(1)
