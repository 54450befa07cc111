"""Exact sets of neighbors where searches go wrong, each cloud by its trait."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

import geokit as gk
from geokit.points import NeighborGrid

SEED = np.random.default_rng(23)
RANDOM = SEED.random((900, 3))
LINE = SEED.random((900, 1))


def lattice(n):
    axis = np.arange(float(n))
    return np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)


# Name: points, radius.
CLOUDS = {
    "negative coordinates": (RANDOM - 5.0, 0.15),
    "both signs": (RANDOM - 0.5, 0.15),
    **{f"extent {extent:g}": (RANDOM * extent, 0.15 * extent) for extent in (1e-6, 1e-3, 1e3, 1e6, 1e9)},
    "extent 1e9, radius 1": (np.concatenate([RANDOM * 1e9, RANDOM]), 1.0),
    "extent 1e-6, offset 1e3": (RANDOM * 1e-6 + 1e3, 1.5e-7),
    "all equal": (np.tile(RANDOM[:1], (400, 1)), 0.1),
    "all equal, radius 0": (np.tile(RANDOM[:1], (400, 1)), 0.0),
    "along x": (LINE * [1.0, 0.0, 0.0], 0.01),
    "along a diagonal": (LINE * [1.0, -2.0, 3.0], 0.02),
    "in a plane": (RANDOM * [1.0, 1.0, 0.0] + [0.0, 0.0, 7.0], 0.05),
    "duplicates": (np.repeat(RANDOM[:150], 5, axis=0), 0.1),
    "duplicates, radius 0": (np.repeat(RANDOM[:150], 5, axis=0), 0.0),
    "radius over the extent": (RANDOM, 2.0),
    "radius far over the extent": (RANDOM, 1e12),
    "radius that is a lattice's distance": (lattice(9), 2.0),
    "radius that is a lattice's diagonal": (lattice(9), np.sqrt(3.0)),
    "lattice of tenths": (lattice(9) * 0.1, 0.2),
    "one point": (RANDOM[:1], 0.1),
    "two points": (RANDOM[:2], 1.0),
    "one far point": (np.concatenate([RANDOM, [[1e12, -1e12, 1e12]]]), 0.15),
    "clusters of clusters": (
        RANDOM[:10].repeat(90, 0) + 1e-3 * RANDOM[10:20].repeat(9, 0).repeat(10, 0) + 1e-6 * RANDOM,
        1e-6,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CLOUDS)
def test_sets_are_those_of_the_tree(name):
    points, radius = CLOUDS[name]
    tree, grid = cKDTree(points), NeighborGrid(points, radius, device="cpu")
    span = np.ptp(points, axis=0).max() + radius
    far = points[:40] + span * np.array([[3.0, -2.0, 1e3]])
    for queries in (points, np.concatenate([points[:60] + 0.3 * radius, far])):
        wanted = tree.query_ball_point(queries, radius, return_sorted=True)
        found = grid.radius_search(queries)
        np.testing.assert_array_equal(found.offsets, np.cumsum([0, *map(len, wanted)]))
        np.testing.assert_array_equal(found.indices, np.concatenate(wanted))
        np.testing.assert_array_equal(grid.count(queries), [len(row) for row in wanted])
    pairs = tree.query_pairs(radius, output_type="ndarray")
    np.testing.assert_array_equal(grid.pairs().indices, pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))])


@pytest.mark.parametrize("name", CLOUDS)
def test_nearest_are_those_of_brute_force(name):
    points, radius = CLOUDS[name]
    grid = NeighborGrid(points, radius, device="cpu")
    queries = np.concatenate([points[:25], points[:10] + 1e3 * np.ptp(points, axis=0).max()])
    d = queries[:, None, :] - points[None, :, :]
    squared = (d[..., 0] ** 2 + d[..., 1] ** 2) + d[..., 2] ** 2
    k = min(12, len(points))
    wanted = np.lexsort((np.broadcast_to(np.arange(len(points)), squared.shape), squared), axis=1)[:, :k]
    found = grid.knn(queries, 12)
    np.testing.assert_array_equal(found.indices[:, :k], wanted)
    np.testing.assert_array_equal(found.distance[:, :k], np.sqrt(np.take_along_axis(squared, wanted, axis=1)))
    assert (found.indices[:, k:] == -1).all()
    assert np.isinf(found.distance[:, k:]).all()
    within = grid.hybrid(queries, 12)
    inside = np.take_along_axis(squared, wanted, axis=1) <= radius * radius
    np.testing.assert_array_equal(within.indices[:, :k], np.where(inside, wanted, -1))


def test_no_points():
    grid = NeighborGrid(np.zeros((0, 3)), 1.0, device="cpu")
    assert grid.count(RANDOM[:4]).tolist() == [0] * 4
    assert grid.pairs().indices.shape == (0, 2)
    assert (grid.knn(RANDOM[:4], 3).indices == -1).all()
    assert grid.knn(k=3).indices.shape == (0, 3)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_named(value):
    bad = RANDOM.copy()
    bad[417, 2] = value
    with pytest.raises(gk.InputError, match="points: row 417"):
        NeighborGrid(bad, 0.1, device="cpu")
    grid = NeighborGrid(RANDOM, 0.1, device="cpu")
    for ask in (grid.count, grid.radius_search, grid.radius_search_blocks, lambda q: grid.knn(q, 3)):
        with pytest.raises(gk.InputError, match="queries: row 417"):
            ask(bad)


@pytest.mark.parametrize("extent", [1e3, 1e9, 1e15])
def test_memory_of_a_pathological_extent(extent):
    # Ten points 1e-3 apart in a box of any size: a table of all its cells would have 1e18 entries and more.
    points = np.concatenate([RANDOM[:500] * 1e-3, extent * RANDOM[500:510]])
    grid = NeighborGrid(points, 1e-4, device="cpu")
    held = sum(
        array.capacity
        for array in vars(grid._cells.grid).values()
        if hasattr(array, "capacity")
    )  # fmt: skip
    # 64 bytes a point, the padding of six arrays, and a table of 65,536 entries and four for each point.
    assert 0 < held < 64 * len(points) + 6 * 64 * 8 + 4 * (65_536 + 4 * len(points)) + 4096
