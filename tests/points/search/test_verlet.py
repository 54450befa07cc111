"""Grids that are updated: bad input, what is kept, and what is made again."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from geokit.errors import InputError
from geokit.points import NeighborGrid
from tests.support.devices import DEVICES

POINTS = np.random.default_rng(0).random((300, 3))


@pytest.mark.parametrize("skin", [0.0, -0.1, np.nan, np.inf])
def test_a_skin_is_a_positive_number(skin):
    with pytest.raises(InputError, match="skin"):
        NeighborGrid(POINTS, 0.2, skin=skin, device="cpu")


def test_a_skin_beyond_float64_is_refused():
    with pytest.raises(InputError, match=r"skin: .* more than a float64 can hold"):
        NeighborGrid(POINTS, 1.7e308, skin=1.7e308, device="cpu")


def test_candidates_need_a_skin():
    with pytest.raises(InputError, match="no skin; give skin="):
        NeighborGrid(POINTS, 0.2, device="cpu").candidates()


@pytest.mark.parametrize("skin", [None, 0.05])
@pytest.mark.parametrize("device", DEVICES)
def test_bad_points_leave_the_grid_as_it_was(device, skin):
    grid = NeighborGrid(POINTS, 0.2, skin=skin, device=device)
    before = grid.count()
    with pytest.raises(InputError, match="299 rows for a grid of 300 points"):
        grid.update(POINTS[1:])
    bad = POINTS.copy()
    bad[7, 1] = np.nan
    with pytest.raises(InputError, match="points: row 7"):
        grid.update(bad)
    with pytest.raises(InputError, match="more than a float64 can hold"):
        grid.update(np.where(np.arange(300)[:, None] < 150, -1.7e308, 1.7e308) * np.ones(3))
    np.testing.assert_array_equal(grid.count(), before)


def test_bad_points_of_a_cell_leave_the_grid_as_it_was():
    grid = NeighborGrid(POINTS, 0.2, periodic=[1, 1, 1], skin=0.05, device="cpu")
    before = grid.count()
    with pytest.raises(InputError, match="more than 16777216 cells"):
        grid.update(POINTS + 1e9)
    np.testing.assert_array_equal(grid.count(), before)


@pytest.mark.parametrize("device", DEVICES)
def test_without_a_skin_the_answers_are_those_of_a_new_grid(device):
    grid = NeighborGrid(POINTS, device=device)
    grid.knn(k=3)
    handle = grid.id
    moved = POINTS[::-1] * [1.0, 2.0, 0.5]
    kept = grid._hash_grid  # so that its address cannot be given out again
    grid.update(moved)
    fresh = NeighborGrid(moved, grid.radius, device=device)
    for one, other in zip(grid.knn(k=3), fresh.knn(k=3), strict=True):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(grid.radius_search(order="any"), fresh.radius_search(order="any"), strict=True):
        np.testing.assert_array_equal(one, other)
    assert grid.id != handle
    del kept


def test_small_queries_are_answered_for_the_new_points():
    grid = NeighborGrid(POINTS, 0.2, device="cpu")
    for _ in range(3):  # the third is replayed
        assert grid.count(POINTS[:2]).min() >= 1
    grid.update(POINTS + 10.0)
    assert grid.count(POINTS[:2]).tolist() == [0, 0]


@pytest.mark.parametrize("device", DEVICES)
def test_candidates_stay_the_same_arrays(device):
    grid = NeighborGrid(POINTS, 0.2, skin=0.05, device=device)
    first = grid.candidates()
    grid.update(POINTS + 0.01)
    if device == "cpu":
        assert np.shares_memory(grid.candidates().indices, first.indices)
    grid.update(POINTS + 0.02)
    # Measured from where the lists were made, not from the last step.
    assert grid._lists is None
    np.testing.assert_array_equal(grid.candidates().indices, first.indices)


def test_the_callers_array_is_not_kept():
    points = POINTS.copy()
    grid = NeighborGrid(POINTS, 0.2, skin=0.05, device="cpu")
    grid.count()
    grid.update(points)
    expected = grid.radius_search().distance
    points += 5.0
    np.testing.assert_array_equal(grid.radius_search().distance, expected)


@pytest.mark.parametrize("skin", [None, 0.05])
def test_blocks_are_of_the_points_when_they_were_asked_for(skin):
    grid = NeighborGrid(POINTS, 0.2, skin=skin, device="cpu")
    expected = np.concatenate([block.neighbors.indices for block in grid.radius_search_blocks(memory=4096)])
    blocks = grid.radius_search_blocks(memory=4096)
    begun = next(blocks)
    grid.update(POINTS * 100.0)
    found = np.concatenate([begun.neighbors.indices, *(block.neighbors.indices for block in blocks)])
    np.testing.assert_array_equal(found, expected)
    assert grid.count().tolist() == [1] * 300


@pytest.mark.parametrize("cell", [None, [1.0, 1.0, 1.0]])
@pytest.mark.parametrize("searched", [False, True])
def test_copies(cell, searched):
    grid = NeighborGrid(POINTS.astype(np.float32), 0.2, periodic=cell, skin=0.05, device="cpu")
    if searched:
        grid.count()
        grid.update(POINTS.astype(np.float32) + np.float32(0.01))
    for other in (pickle.loads(pickle.dumps(grid)), copy.deepcopy(grid)):
        assert repr(other) == repr(grid)
        assert "skin=0.05" in repr(other)
        for one, two in zip(other.radius_search(), grid.radius_search(), strict=True):
            assert one.dtype == two.dtype
            np.testing.assert_array_equal(one, two)
        assert len(other.candidates().indices) > 0


def test_containers_may_change():
    torch = pytest.importorskip("torch")
    grid = NeighborGrid(POINTS, 0.2, skin=0.05, device="cpu")
    expected = grid.radius_search()
    grid.update(torch.tensor(POINTS))
    assert isinstance(grid.radius_search().indices, torch.Tensor)
    np.testing.assert_array_equal(grid.radius_search().distance.numpy(), expected.distance)
    moved = torch.tensor(POINTS, requires_grad=True)
    grid.update(moved)
    grid.knn(k=2).distance.sum().backward()
    assert moved.grad.abs().sum() > 0.0
