"""Moving points: a grid with a skin answers as a new grid without one, bit for bit, with lists kept or made again."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geokit.points import NeighborGrid
from tests.support.devices import DEVICES
from tests.support.effort import of_all

relaxed = settings(deadline=None, max_examples=of_all(15, 60))
BOX = np.diag([1.0, 0.8, 1.2])
SHEARED = np.array([[1.0, 0.0, 0.0], [0.4, 1.0, 0.0], [0.2, -0.3, 1.1]])


def require_same(one, other):
    for a, b in zip(one, other, strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def require_same_answers(moved, points, radius, cell):
    fresh = NeighborGrid(points, radius, periodic=cell, device=moved.device)
    for order in ("index", "distance"):
        for exclude in (False, True):
            asked = {"order": order, "exclude_self": exclude}
            require_same(moved.radius_search(**asked), fresh.radius_search(**asked))
            if cell is not None:
                require_same(moved.neighbor_list(**asked), fresh.neighbor_list(**asked))
    require_same(moved.radius_search(order="any"), fresh.radius_search())
    for within in (radius, 0.6 * radius, 1.4 * radius):
        require_same([moved.count(radius=within)], [fresh.count(radius=within)])
    require_same(moved.radius_search(points[:50]), fresh.radius_search(points[:50]))
    if cell is None:
        require_same(moved.pairs(), fresh.pairs())
        require_same(moved.knn(k=5), fresh.knn(k=5))


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("cell", [None, BOX, SHEARED], ids=["open", "box", "sheared"])
@pytest.mark.parametrize("dtype", of_all([np.float32], [np.float64, np.float32]))
def test_moved_points_are_answered_as_by_a_new_grid(device, cell, dtype):
    random = np.random.default_rng(3)
    points, radius, skin = random.random((2500, 3)).astype(dtype), 0.11, 0.03
    grid = NeighborGrid(points, radius, periodic=cell, skin=skin, device=device)
    kept = []
    for step in range(9):
        require_same_answers(grid, points, radius, cell)
        points = points + (random.normal(size=points.shape) * 0.0012 + [0.002, 0.0, 0.0]).astype(dtype)
        if cell is not None and step in (2, 3):
            # Programs move points that leave the cell back into it, each in its own step.
            points = points + (random.integers(-2, 3, points.shape) @ cell).astype(dtype)
        grid.update(points)
        kept.append(grid._lists is not None)
    # Both happened: lists were kept, over the boundary too, and made again.
    assert any(kept)
    assert not all(kept)
    assert kept[3]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("groups", [[0, 0, 700, 1500], [0, 1500]])
def test_groups_are_told_apart(device, groups):
    random = np.random.default_rng(4)
    points = random.random((1500, 3))
    grid = NeighborGrid(points, 0.1, groups=groups, skin=0.02, device=device)
    for _ in range(3):
        fresh = NeighborGrid(points, 0.1, groups=groups, device=device)
        require_same(grid.radius_search(exclude_self=True), fresh.radius_search(exclude_self=True))
        points = points + random.normal(size=points.shape) * 0.001
        grid.update(points)
    assert grid._lists is not None


@pytest.mark.parametrize("device", DEVICES)
@relaxed
@given(st.data())
def test_no_pair_is_missed_at_the_limits(device, data):
    """Pairs at the rim of the lists that approach each other by half the skin each, give or take some roundings."""
    random = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    radius, skin = 10.0 ** random.uniform(-6, 6, 2)
    skin = data.draw(st.sampled_from([skin, 0.3 * radius, 1e-9 * radius, 1e-15 * radius, 1e-17 * radius]))
    far = data.draw(st.sampled_from([0.0, 1e3, 1e12])) * radius
    count = 40
    way = random.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    first = random.normal(size=(count, 3)) * far
    second = first + way * ((radius + skin) * (1.0 + random.integers(-3, 4, (count, 1)) * 2.3e-16))
    # Each pair is far from the others.
    first[:, 0] += np.arange(count) * (8.0 * radius + 8.0 * skin)
    second[:, 0] += np.arange(count) * (8.0 * radius + 8.0 * skin)
    grid = NeighborGrid(np.vstack([first, second]), radius, skin=skin, device=device)
    grid.count()
    nearer = way * (0.5 * skin * (1.0 + random.integers(-3, 4, (count, 1)) * 2.3e-16))
    moved = np.vstack([first + nearer, second - nearer])
    grid.update(moved)
    require_same(grid.radius_search(), NeighborGrid(moved, radius, device=device).radius_search())


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("cell", [None, SHEARED], ids=["open", "sheared"])
@pytest.mark.parametrize("exclude_self", [False, True])
def test_candidates_hold_all_neighbors_and_none_far_away(device, cell, exclude_self):
    random = np.random.default_rng(5)
    points, radius, skin = random.random((1200, 3)), 0.12, 0.05
    grid = NeighborGrid(points, radius, periodic=cell, skin=skin, device=device)
    before = grid.candidates(exclude_self=exclude_self)
    for step in range(4):
        if step:
            points = points + random.normal(size=points.shape) * 0.0015
        if cell is not None and step == 2:
            points = points + random.integers(-1, 2, points.shape) @ cell
        grid.update(points)
        offsets, indices, shifts = grid.candidates(exclude_self=exclude_self)
        assert grid._lists is not None
        np.testing.assert_array_equal(indices, before.indices)
        row = np.repeat(np.arange(len(points)), np.diff(offsets))
        assert (np.diff(indices)[np.diff(row) == 0] >= (0 if cell is not None else 1)).all()
        at = points[indices] if cell is None else points[indices] + shifts @ cell
        distance = np.linalg.norm(at - points[row], axis=1)
        assert distance.max() <= radius + 2.0 * skin
        near = distance <= radius
        fresh = NeighborGrid(points, radius, periodic=cell, device=device)
        if cell is None:
            found = fresh.radius_search(exclude_self=exclude_self)
            assert shifts is None
        else:
            found = fresh.neighbor_list(exclude_self=exclude_self)
            np.testing.assert_array_equal(shifts[near], found.shifts)
        np.testing.assert_array_equal(indices[near], found.indices)
        np.testing.assert_array_equal(row[near], np.repeat(np.arange(len(points)), np.diff(found.offsets)))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [0, 1, 7])
@pytest.mark.parametrize("cell", [None, BOX], ids=["open", "box"])
def test_few_points(device, count, cell):
    points = np.random.default_rng(6).random((count, 3))
    grid = NeighborGrid(points, 0.9, periodic=cell, skin=0.1, device=device)
    for _ in range(2):
        fresh = NeighborGrid(points, 0.9, periodic=cell, device=device)
        require_same(grid.radius_search(), fresh.radius_search())
        require_same([grid.count(exclude_self=True)], [fresh.count(exclude_self=True)])
        points = points + 0.01
        grid.update(points)


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_long_rows(device):
    """Rows with more candidates than one buffer of the search holds, and points in one place."""
    random = np.random.default_rng(7)
    points = np.vstack([random.random((2500, 3)), np.zeros((300, 3))])
    grid = NeighborGrid(points, 0.7, skin=0.1, device=device)
    grid.count()
    points = points + random.normal(size=points.shape) * 0.005
    grid.update(points)
    assert grid._lists is not None
    require_same(grid.radius_search(), NeighborGrid(points, 0.7, device=device).radius_search())
