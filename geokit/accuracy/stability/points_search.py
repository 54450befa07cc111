"""Sweeps of neighbor searches: radius, crowding, extent, duplicates, and number of neighbors."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.trials.model import Judgement, Sweeps

__all__ = ["SWEEPS"]

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
