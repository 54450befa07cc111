"""Radius search pushed towards failure: offset, scale, outliers, clusters, extreme radii, and the memory they take."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from geokit.points import NeighborGrid
from geokit.points.search.cells import TABLE_ENTRIES_MORE, TABLE_ENTRIES_PER_POINT

RANDOM_POINTS = np.random.default_rng(7).random((1500, 3))
RADIUS = 0.12


def assert_like_tree(points, radius, *, build_radius=None):
    grid = NeighborGrid(points, build_radius or radius, device="cpu")
    found = grid.radius_search(points, radius=radius)
    wanted = cKDTree(points).query_ball_point(points, radius, return_sorted=True)
    np.testing.assert_array_equal(found.offsets, np.cumsum([0, *map(len, wanted)]))
    np.testing.assert_array_equal(found.indices, np.concatenate(wanted))
    return grid


def candidates_per_query(grid, queries, radius):
    """Points that a query looks at on average: those in the rows of cells that its cube touches, replayed in NumPy."""
    g = grid._cells.grid
    knots, inverse, first, count = g.cut.numpy().T

    def cells(values):
        columns = []
        for axis in range(3):
            begin, end = g.first_cut[axis], g.last_cut[axis] + 1
            i = np.clip(np.searchsorted(knots[begin:end], values[:, axis], side="right") - 1, 0, None) + begin
            columns.append(first[i] + np.clip((values[:, axis] - knots[i]) * inverse[i], 0, count[i] - 1).astype(int))
        return np.stack(columns, axis=1)

    n = len(grid)
    at = cells(np.stack([g.x.numpy()[:n], g.y.numpy()[:n], g.z.numpy()[:n]], axis=1))
    low, high = cells(queries - radius), cells(queries + radius)
    return np.mean([np.all((at >= a) & (at <= b), axis=1).sum() for a, b in zip(low, high, strict=True)])


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e6, 1e9])
def test_far_from_the_origin(offset):
    # At 1e9 coordinates have steps of 1.2e-7: the points have moved, but they are compared where they are.
    assert_like_tree(RANDOM_POINTS + offset, RADIUS)


@pytest.mark.parametrize("scale", [1e-100, 1e-8, 1e-4, 1.0, 1e4, 1e8, 1e100])
def test_scales(scale):
    assert_like_tree(RANDOM_POINTS * scale, RADIUS * scale)


@pytest.mark.parametrize("far", [1e2, 1e4, 1e6, 1e9, 1e15])
def test_one_far_point_leaves_the_cells_of_the_others_alone(far):
    points = RANDOM_POINTS.copy()
    points[100] = far
    grid = assert_like_tree(points, RADIUS)
    plain = NeighborGrid(RANDOM_POINTS, RADIUS, device="cpu")
    queries = RANDOM_POINTS[:60]
    assert candidates_per_query(grid, queries, RADIUS) <= 1.2 * candidates_per_query(plain, queries, RADIUS)


@pytest.mark.parametrize("size", [1e-2, 1e-4, 1e-6, 1e-9])
def test_clusters_small_against_their_distances(size):
    random = np.random.default_rng(0)
    centers = random.random((8, 3))
    points = centers[random.integers(0, 8, 4000)] + size * random.random((4000, 3))
    grid = assert_like_tree(points, size / 4)
    # Half a cluster is 250 points; the cube of three cells of a quarter of it holds 0.42 of its volume at most.
    assert candidates_per_query(grid, points[:60], size / 4) < 300


@pytest.mark.parametrize("ratio", [1e-12, 1e-9, 1e-6, 1e-3, 1.0, 1e3, 1e12])
def test_radius_against_extent(ratio):
    assert_like_tree(RANDOM_POINTS[:300], ratio)


@pytest.mark.parametrize("ratio", [1e-6, 1e-3, 0.4, 2.5, 1e3, 1e6])
def test_query_radius_against_the_grid_s(ratio):
    assert_like_tree(RANDOM_POINTS[:300], RADIUS, build_radius=RADIUS / ratio)


@pytest.mark.parametrize("radius", [5e-324, 1e-300, 1e-200, 1e-162, 1e-160, 1e-150])
def test_radii_whose_squares_vanish(radius):
    # Squares under 2.5e-324 are 0: points that near each other are at distance 0 for any formula in float64.
    points = np.zeros((5, 3))
    points[:, 0] = [0.0, 1e-170, 1e-161, 3e-160, 1.0]
    d = points[:, None, 0] - points[None, :, 0]
    near = d * d <= radius * radius
    found = NeighborGrid(points, radius, device="cpu").radius_search(points)
    assert np.diff(found.offsets).tolist() == near.sum(axis=1).tolist()


@pytest.mark.parametrize("radius", [1e150, 1e160, 1.7e308])
def test_radii_whose_squares_overflow(radius):
    found = NeighborGrid(RANDOM_POINTS[:40] * 1e155, radius, device="cpu").count(RANDOM_POINTS[:40] * 1e155)
    expected = 1 if radius < 1e153 else 40
    assert found.tolist() == [expected] * 40


@pytest.mark.parametrize("extent", [1.0, 1e3, 1e6, 1e12, 1e300])
@pytest.mark.parametrize("count", [1, 100, 1500])
def test_memory_is_bounded_by_the_points_alone(extent, count):
    points = RANDOM_POINTS[:count].copy()
    points[0] = extent
    grid = NeighborGrid(points, 1e-3, device="cpu")._cells.grid
    assert len(grid.start) <= TABLE_ENTRIES_PER_POINT * count + TABLE_ENTRIES_MORE
    start = grid.start.numpy()
    assert (start[0], start[-1]) == (0, count)
    assert (np.diff(start) >= 0).all()


def test_neighbors_across_the_edges_of_cells():
    # Points on either side of every boundary of cells one unit long, one step of float64 apart.
    edges = np.arange(1.0, 9.0)
    x = np.concatenate([edges, np.nextafter(edges, -np.inf), np.nextafter(edges, np.inf)])
    points = np.stack([x, np.roll(x, 5), np.roll(x, 11)], axis=1)
    for radius in (1e-15, 1.0, np.nextafter(1.0, 0.0), np.nextafter(1.0, 2.0), np.sqrt(3.0)):
        assert_like_tree(points, float(radius), build_radius=1.0)
        assert_like_tree(points, float(radius))
