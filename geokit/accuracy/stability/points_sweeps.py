"""Sweeps of point clouds: neighbor searches, normals, registration and densities."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.stability.fields import unit_vectors
from geokit.accuracy.stability.shapes import judged
from geokit.accuracy.trials.model import Judgement, Sweeps, cases_of

SWEEPS = Sweeps()
Floats = NDArray[np.float64]

# Points of a cloud in the unit cube, and the number of them used as queries.
COUNT, ASKED = 2000, 200
SPACING = COUNT ** (-1 / 3)
# Two roundings of float64: of the squared distance, and of the distance itself.
ROUNDING = 2.0**-51
# Most neighbors of a query, and the number of points of a cloud with more.
MOST_NEIGHBORS, MANY = 1024, 3000
# Share of the volume that holds the crowd.
CROWDED = 0.01
EXACT = "sets of neighbors are exact, and distances to 2^-51: no failure found."
of_radius = partial(SWEEPS.add, "points.NeighborGrid.radius_search", "radii", error=ROUNDING)
of_normals = partial(SWEEPS.add, "points.normals", "degrees")
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
LATTICE, AROUND = 9, 4.0


@of_radius(
    "radius_search_radius",
    "radius [spacings], cells made for 2 spacings",
    (1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3),
    last=1e3,
    statement=f"From a thousandth of the spacing to a thousand spacings {EXACT}",
)
def radii(ratio: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Neighbors within a multiple of the spacing, in cells made for twice the spacing."""
    points = np.random.default_rng(seed).random((COUNT, 3))
    return _searched(points, 2.0 * SPACING, ratio * SPACING, seed, device)


@of_radius(
    "radius_search_crowd",
    "share of the points in 1 % of the volume",
    (0.01, 0.1, 0.5, 0.9, 0.99, 1.0),
    last=1.0,
    statement=f"With any share of the points in 1 % of the volume, {EXACT}",
    logarithmic=False,
)
def crowds(share: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Neighbors in a cloud with a share of its points in a small cube."""
    random = np.random.default_rng(seed)
    points = random.random((COUNT, 3))
    crowd = random.permutation(COUNT)[: round(share * COUNT)]
    points[crowd] = 0.3 + points[crowd] * CROWDED ** (1 / 3)
    return _searched(points, SPACING, SPACING, seed, device)


@of_radius(
    "radius_search_extent",
    "extent of the cloud [radii]",
    (1e-6, 1e-3, 1.0, 1e3, 1e6, 1e9, 1e12, 1e15),
    last=1e15,
    statement=f"In clouds that are 1e-6 to 1e15 radii wide {EXACT}",
)
def extents(ratio: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Neighbors within 1 in a cloud of extent ``ratio``, half of it within a few radii of the center."""
    random = np.random.default_rng(seed)
    points = ratio * (random.random((COUNT, 3)) - 0.5)
    points[: COUNT // 2] = min(ratio, 8.0) * (random.random((COUNT // 2, 3)) - 0.5)
    return _searched(points, 1.0, 1.0, seed, device)


@of_radius(
    "radius_search_duplicates",
    "points in one place",
    (1.0, 10.0, 100.0, 1000.0),
    last=1000.0,
    statement=f"With up to 1000 points in one place {EXACT}",
)
def duplicates(copies: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Neighbors in a cloud with ``copies`` copies of each point."""
    random = np.random.default_rng(seed)
    places = random.random((COUNT // int(copies), 3))
    points = random.permutation(np.repeat(places, int(copies), axis=0))
    return _searched(points, 2.0 * SPACING, 2.0 * SPACING, seed, device)


@SWEEPS.add(
    "points.NeighborGrid.knn",
    "relative",
    "knn_k",
    "neighbors of a query",
    (1.0, 8.0, 32.0, 128.0, 512.0, 1024.0, 1025.0, 2048.0),
    last=float(MOST_NEIGHBORS),
    error=ROUNDING,
    statement=f"Up to {MOST_NEIGHBORS} nearest points are exact, ties by the lowest index; more are refused.",
)
def nearest(k: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """The k nearest points of a cloud in which some points coincide; errors are relative to the distance."""
    from geokit.points.neighbors.neighbor_grid import NeighborGrid

    random = np.random.default_rng(seed)
    points = random.random((MANY, 3))
    points[:30] = points[30:60]
    queries = np.concatenate([points[:20], random.random((20, 3))])
    found = NeighborGrid(points, device=device).knn(queries, int(k))
    true, indices = reference.k_nearest(points, int(k), queries)
    wrong = (found.indices != indices).any(axis=1)
    scale = np.where(true > 0.0, true, 1.0)
    return Judgement((np.abs(found.distance - true) / scale).max(axis=1), wrong, queries)


def _searched(points: Floats, cell: float, radius: float, seed: int, device: Any) -> Judgement:
    """Radius search against the reference: a different set or count is wrong; errors are in radii."""
    from geokit.points.neighbors.neighbor_grid import NeighborGrid

    queries = points[np.random.default_rng([seed, 1]).permutation(len(points))[:ASKED]]
    grid = NeighborGrid(points, cell, device=device)
    found, counts = grid.radius_search(queries, radius=radius), grid.count(queries, radius=radius)
    true = reference.neighbors_within(points, queries, radius)
    errors, wrong = np.zeros(len(queries)), np.zeros(len(queries), bool)
    for i, wanted in enumerate(true):
        row = slice(found.offsets[i], found.offsets[i + 1])
        wrong[i] = counts[i] != len(wanted) or not np.array_equal(found.indices[row], wanted)
        if not wrong[i]:
            apart = np.linalg.norm(points[wanted] - queries[i], axis=1)
            errors[i] = np.abs(found.distance[row] - apart).max(initial=0.0) / radius
    return Judgement(errors, wrong, queries)


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
    queries = np.random.default_rng(seed).uniform(-AROUND, AROUND, (2000, 3))
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
