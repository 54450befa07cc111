"""Sweeps of normals, registration and densities."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.stability.fields import unit_vectors
from geokit.accuracy.stability.mesh_questions import judged
from geokit.accuracy.trials.model import Judgement, Sweeps, cases_of

__all__ = ["SWEEPS"]

SWEEPS = Sweeps()
of_normals = partial(SWEEPS.add, "points.normals", "degrees")
Floats = NDArray[np.float64]

# Default number of neighbors of a normal, and points along a side of the noisy plane.
K, SIDE = 16, 50
# Radius of the tube of a torus, the number of points on it, and the most neighbors requested.
MINOR, ON_TORUS, MOST = 0.35, 2500, 1024
# Half axes of the registered ellipsoid, its number of points, and the number of rotations tried for each angle.
AXES = np.array([1.0, 0.7, 0.45])
ON_ELLIPSOID, TRIALS = 300, 3
# Recovered poses are exact up to rounding; larger deviations are other poses.
FOUND = 1e-9
# Half the side of the lattice of density 1, and the extent of its queries [spacings].
LATTICE, ASKED = 9, 4.0


@of_normals(
    "normals_noise",
    "noise [spacings], k = 16",
    (1e-4, 1e-3, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0),
    last=0.1,
    error=15.0,
    statement="Noise of a tenth of the spacing tilts normals by at most 15 degrees (1.6 in the median) at k = 16, "
    "less noise in proportion; at noise of a whole spacing directions carry no information.",
)
def noisy_planes(noise: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Normals of a noisy plane with one random point in each cell."""
    random = np.random.default_rng(seed)
    cells = np.stack(np.meshgrid(*2 * [np.arange(float(SIDE))]), axis=-1).reshape(-1, 2)
    flat = cells + random.random(cells.shape)
    points = np.column_stack([flat, noise * random.normal(size=len(flat))])
    return _angles(points, np.array([0.0, 0.0, 1.0]), K, device)


@of_normals(
    "normals_curvature",
    "radius of the neighborhood [radii of curvature]",
    (0.6, 0.8, 1.2, 1.6, 2.4, 3.2),
    last=1.2,
    error=30.0,
    statement="Neighborhoods with a radius of up to 1.2 radii of curvature give normals to 30 degrees at worst (4 "
    "rms); neighborhoods twice as large reach around the body, and normals may be those of another side.",
)
def wide_planes(width: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Normals of a torus from neighborhoods as wide as ``width`` times its tube's radius."""
    random = np.random.default_rng(seed)
    u, v, kept = random.random((3, 3 * ON_TORUS))
    u, v = 2.0 * np.pi * u, 2.0 * np.pi * v
    # Uniform by area: the outer side has more of it.
    chosen = kept * (1.0 + MINOR) < 1.0 + MINOR * np.cos(v)
    u, v = u[chosen][:ON_TORUS], v[chosen][:ON_TORUS]
    normals = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], axis=1)
    points = np.stack([np.cos(u), np.sin(u), np.zeros(len(u))], axis=1) + MINOR * normals
    area = 4.0 * np.pi**2 * MINOR
    k = round(len(points) * np.pi * (width * MINOR) ** 2 / area)
    return _angles(points, normals, min(k, MOST), device)


@SWEEPS.add(
    "points.register, {method}",
    "sizes",
    "register_{method}_angle",
    "angle of the start [degrees]",
    (1.0, 10.0, 30.0, 45.0, 90.0, 135.0, 180.0),
    cases=cases_of("method", ("point_to_plane",), ("point_to_point",)),
    last=45.0,
    error=1e-12,
    statement="A noise-free ellipsoid (axes 1, 0.7, 0.45) is recovered exactly from starts rotated by up to 45 "
    "degrees; from 90 degrees on some runs end at another pose, which rmse shows.",
    logarithmic=False,
)
def turned_ellipsoids(angle: float, *, method: str, seed: int = 0, device: Any = None) -> Judgement:
    """Registration of an ellipsoid's points to a rotated copy; other poses are wrong."""
    from geokit.points._register import register

    errors, wrong = np.zeros(TRIALS), np.zeros(TRIALS, bool)
    for i in range(TRIALS):
        points = unit_vectors(ON_ELLIPSOID, 10 * seed + i) * AXES
        normals = points / AXES**2
        turn = _rotation(unit_vectors(1, 1000 + 10 * seed + i)[0], np.radians(angle))
        target = points @ turn.T
        found = register(
            points, target, target_normals=normals @ turn.T, method=method, max_iterations=100, device=device
        ).transform
        off = float(np.abs(points @ found[:3, :3].T + found[:3, 3] - target).max())
        errors[i], wrong[i] = off, off > FOUND
    return Judgement(errors, wrong)


# Errors measured on a lattice at 2 to 4 spacings: 0.24, 0.0053, 0.034 and 0.016. ``scattered`` is the rms error at
# three spacings of random points.
@SWEEPS.add(
    "points.density, {kernel}",
    "relative",
    "density_{kernel}_radius",
    "radius [spacings]",
    (4.0, 3.0, 2.0, 1.5, 1.0, 0.75, 0.5),
    cases=cases_of(
        "kernel error scattered",
        ("count", 0.5, 0.10),
        ("cubic_spline", 0.02, 0.21),
        ("wendland_c2", 0.08, 0.23),
        ("poly6", 0.05, 0.18),
    ),
    last=2.0,
    statement="On a lattice a radius of 2 spacings or more gives the density to {error:.0%}; a radius of 1 spacing "
    "gives nothing like it. Random points scatter more: {scattered:.0%} rms at 3 spacings.",
)
def lattice_densities(radius: float, *, kernel: str, seed: int = 0, device: Any = None) -> Judgement:
    """Densities at random positions in a lattice of spacing 1; the exact density is 1."""
    from geokit.points._density import density

    axis = np.arange(-LATTICE, LATTICE + 1.0)
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    queries = np.random.default_rng(seed).uniform(-ASKED, ASKED, (2000, 3))
    found = density(points, radius=radius, kernel=kernel, queries=queries, device=device)
    return judged(found - 1.0, False, queries)


def _angles(points: Floats, true: Floats, k: int, device: Any) -> Judgement:
    """Angles between normals and the true ones, of either sign [degrees]; a missing normal is wrong."""
    from geokit.points._normals import normals

    found = normals(points, k=k, orientation="none", device=device).normals
    cosine = np.abs((found * true).sum(axis=1))
    sine = np.linalg.norm(np.cross(found, true), axis=1)
    return Judgement(np.degrees(np.arctan2(sine, cosine)), ~found.any(axis=1), points)


def _rotation(axis: Floats, angle: float) -> Floats:
    """Rotation matrix about a unit axis, by Rodrigues' formula."""
    x, y, z = axis
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn: Floats = np.eye(3) + np.sin(angle) * across + (1.0 - np.cos(angle)) * across @ across
    return turn
