"""Periodic cells on hand-sized inputs: answers, containers and every error."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit.core.memory import available_memory
from geokit.points import NeighborGrid
from tests.support.devices import DEVICES

POINTS = np.array([[0.125, 0.5, 0.5], [0.875, 0.5, 0.5], [0.5, 0.5, 0.0625]])
BOX = [1.0, 1.0, 1.0]


@pytest.mark.parametrize("device", DEVICES)
def test_across_the_faces(device):
    grid = NeighborGrid(POINTS, 0.25, periodic=BOX, device=device)
    assert grid.count().tolist() == [2, 2, 1]
    found = grid.neighbor_list(exclude_self=True)
    assert found._fields == ("offsets", "indices", "distance", "shifts")
    assert found.offsets.tolist() == [0, 1, 2, 2]
    assert found.indices.tolist() == [1, 0]
    assert found.distance.tolist() == [0.25, 0.25]
    assert found.shifts.tolist() == [[-1, 0, 0], [1, 0, 0]]
    assert grid.radius_search(exclude_self=True).indices.tolist() == [1, 0]
    assert [block.indices.tolist() for _, block in grid.radius_search_blocks(memory=12)] == [[0, 1], [0, 1], [2]]
    # From where the query and the points were given, many cells away.
    moved = NeighborGrid(POINTS + np.array([[4, 0, 0], [0, 0, 0], [0, 0, 0]]), 0.25, periodic=np.eye(3), device=device)
    found = moved.neighbor_list([[-8.0, 0.5, 0.5]])
    assert found.indices.tolist() == [0, 1]
    assert found.shifts.tolist() == [[-12, 0, 0], [-9, 0, 0]]
    assert found.distance.tolist() == [0.125, 0.125]


def test_a_radius_longer_than_the_cell():
    grid = NeighborGrid([[0.0, 0, 0]], 1.0, periodic=[1.0, 2.0, 4.0], device="cpu")
    found = grid.neighbor_list(order="distance")
    assert found.indices.tolist() == [0, 0, 0]
    assert found.shifts.tolist() == [[0, 0, 0], [-1, 0, 0], [1, 0, 0]]
    # A longer radius makes more images; a shorter one uses those that there are.
    assert grid.count(radius=2.0).tolist() == [7]
    assert grid.count(radius=0.5).tolist() == [1]
    assert grid.count(radius=np.array([2.25])).tolist() == [11]


def test_sheared():
    # The nearest image is not the one that rounding the fractions names.
    cell = np.array([[1.0, 0, 0], [0.5, 0.25, 0], [0, 0, 1]])
    found = NeighborGrid([[0.0, 0, 0]], 0.6, periodic=cell, device="cpu").neighbor_list(exclude_self=True)
    assert found.shifts.tolist() == [[-1, 2, 0], [0, -1, 0], [0, 1, 0], [1, -2, 0], [-1, 1, 0], [1, -1, 0]][
        :0
    ] + sorted([[-1, 1, 0], [-1, 2, 0], [0, -1, 0], [0, 1, 0], [1, -2, 0], [1, -1, 0]])


def test_containers_and_copies():
    grid = NeighborGrid(wp.array(POINTS, dtype=wp.vec3f, device="cpu"), 0.3, periodic=BOX, device="cpu")
    found = grid.neighbor_list()
    assert isinstance(found.shifts, wp.array)
    assert found.shifts.shape == (len(found.indices), 3)
    assert found.distance.dtype == wp.float32
    single = NeighborGrid(POINTS, 0.3, periodic=BOX, device="cpu").neighbor_list([0.0, 0.5, 0.5])
    assert single.shifts.dtype == np.int32
    assert single.shifts.tolist() == [[0, 0, 0], [-1, 0, 0]]
    again = pickle.loads(pickle.dumps(NeighborGrid(POINTS + 7.0, 0.25, periodic=BOX, device="cpu")))
    assert again.count().tolist() == [2, 2, 1]
    assert repr(again) == "NeighborGrid(3 points in a periodic cell, radius=0.25, device='cpu')"
    nothing = NeighborGrid(np.zeros((0, 3)), 0.3, periodic=BOX, device="cpu")
    assert nothing.neighbor_list().shifts.shape == (0, 3)
    assert nothing.count(POINTS).tolist() == [0, 0, 0]


def test_a_default_radius():
    assert NeighborGrid(POINTS, periodic=BOX, device="cpu").count().min() >= 1


def test_errors(monkeypatch):
    for cell, message in (
        ([1, 1], r"periodic: shape \(2,\) is neither"),
        (3.0, r"periodic: shape \(\) is neither"),
        ([1, 0, 1], "periodic: edge 1 is 0"),
        ([1, np.inf, 1], "periodic: the cell is not finite"),
        ([[1, 0, 0], [0, 1, 0], [1, 1, 0]], "periodic: the vectors .* hardly span"),
        ([[1, 0, 0], [0, 1, 0], [0, 0, 0]], "periodic: the vectors .* hardly span"),
        ("box", "periodic"),
    ):
        with pytest.raises(gk.InputError, match=message):
            NeighborGrid(POINTS, 0.3, periodic=cell, device="cpu")
    with pytest.raises(gk.InputError, match="periodic: groups have no common cell"):
        NeighborGrid(POINTS, 0.3, periodic=BOX, groups=[0, 3], device="cpu")
    with pytest.raises(gk.InputError, match="points: a coordinate is 1e"):
        NeighborGrid(POINTS * [[1], [1], [2e9]], 0.3, periodic=BOX, device="cpu")
    grid = NeighborGrid(POINTS, 0.3, periodic=BOX, device="cpu")
    for ask in (grid.count, grid.neighbor_list, grid.radius_search_blocks):
        with pytest.raises(gk.InputError, match="queries: a coordinate is 1e"):
            ask([[0, 0, 1e9]])
        with pytest.raises(gk.InputError, match="queries: row 0"):
            ask([[0, 0, np.nan]])
        with pytest.raises(gk.InputError, match="exclude_self: queries in a periodic cell"):
            ask(POINTS, exclude_self=True)
    for ask in (grid.pairs, grid.knn, grid.hybrid, lambda: grid.id):
        with pytest.raises(gk.InputError, match="periodic: not for"):
            ask()
    with pytest.raises(gk.InputError, match="neighbor_list: the grid is not periodic"):
        NeighborGrid(POINTS, 0.3, device="cpu").neighbor_list()
    with pytest.raises(gk.InputError, match="order"):
        grid.neighbor_list(order="shift")
    with pytest.raises(gk.DeviceMemoryError, match=r"periodic: 3 points and about .* images"):
        grid.count(radius=1e5)
    # The grid is as it was.
    assert grid.count().tolist() == [2, 2, 1]
    monkeypatch.setattr(available_memory, "available", lambda _: 100)
    with pytest.raises(gk.DeviceMemoryError, match="use a smaller radius"):
        NeighborGrid(POINTS, 0.3, periodic=BOX, device="cpu")
