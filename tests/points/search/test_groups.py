"""Groups of points and of queries: answers by hand, containers and every error."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit.points import NeighborGrid
from tests.support.devices import DEVICES

# Three groups at one place, the second without points.
POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 0], [0, 1, 0], [5, 5, 5]])
GROUPS = [0, 2, 2, 5]
QUERIES = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0]])
EACH = [0, 1, 2, 3]


def rows(found):
    return [found.indices[a:b].tolist() for a, b in zip(found.offsets[:-1], found.offsets[1:], strict=True)]


@pytest.mark.parametrize("device", DEVICES)
def test_a_hand_made_set(device):
    grid = NeighborGrid(POINTS, 1.0, groups=GROUPS, device=device)
    assert grid.count().tolist() == [2, 2, 2, 2, 1]
    assert rows(grid.radius_search(exclude_self=True)) == [[1], [0], [3], [2], []]
    assert rows(grid.radius_search(QUERIES, groups=EACH)) == [[0, 1], [], [2, 3]]
    assert grid.pairs().indices.tolist() == [[0, 1], [2, 3]]
    assert grid.knn(QUERIES, 3, groups=EACH).indices.tolist() == [[0, 1, -1], [-1, -1, -1], [2, 3, 4]]
    assert grid.hybrid(k=2).indices.tolist() == [[0, 1], [1, 0], [2, 3], [3, 2], [4, -1]]
    # All queries in one group, which need not be the first.
    assert grid.count(QUERIES, groups=[0, 0, 0, 3]).tolist() == [2, 2, 2]


@pytest.mark.parametrize("device", DEVICES)
def test_blocks_and_a_radius_for_each_query(device):
    grid = NeighborGrid(POINTS, 1.0, groups=GROUPS, device=device)
    radius = np.array([0.0, 5.0, 100.0])
    found = grid.radius_search(QUERIES, radius=radius, groups=EACH)
    assert rows(found) == [[0], [], [2, 3, 4]]
    blocks = [rows(block) for _, block in grid.radius_search_blocks(QUERIES, radius=radius, groups=EACH, memory=12)]
    assert [row for block in blocks for row in block] == rows(found)
    own = [rows(block) for _, block in grid.radius_search_blocks(memory=12, exclude_self=True)]
    assert [row for block in own for row in block] == [[1], [0], [3], [2], []]


def test_containers():
    grid = NeighborGrid(wp.array(POINTS, dtype=wp.vec3d, device="cpu"), 1.0, groups=np.int32(GROUPS), device="cpu")
    found = grid.radius_search(wp.array(QUERIES, dtype=wp.vec3f, device="cpu"), groups=wp.array(EACH, device="cpu"))
    assert isinstance(found.indices, wp.array)
    assert found.indices.numpy().tolist() == [0, 1, 2, 3]
    assert repr(grid) == "NeighborGrid(5 points in 3 groups, radius=1, device='cpu')"
    again = pickle.loads(pickle.dumps(NeighborGrid(POINTS, 1.0, groups=GROUPS, device="cpu")))
    assert again.count().tolist() == [2, 2, 2, 2, 1]


def test_without_points_and_without_groups():
    nothing = NeighborGrid(np.zeros((0, 3)), 1.0, groups=[0, 0, 0], device="cpu")
    assert nothing.count(QUERIES, groups=[0, 1, 3]).tolist() == [0, 0, 0]
    assert nothing.knn(QUERIES, 1, groups=[0, 1, 3]).indices.tolist() == [[-1], [-1], [-1]]
    assert nothing.count().tolist() == []
    none = NeighborGrid(np.zeros((0, 3)), 1.0, groups=[0], device="cpu")
    assert none.count(np.zeros((0, 3)), groups=[0]).tolist() == []


def test_the_default_radius_is_that_of_the_groups():
    random = np.random.default_rng(0)
    cloud = random.random((400, 3))
    # Twenty clouds in one place are no denser than one.
    one = NeighborGrid(cloud, device="cpu")
    many = NeighborGrid(np.tile(cloud, (20, 1)), groups=np.arange(21) * 400, device="cpu")
    assert many.radius == pytest.approx(one.radius, rel=0.1)


def test_errors():
    for groups, message in (
        ([[0, 5]], r"groups: shape \(1, 2\)"),
        ([], "groups: shape"),
        ([0, 1.5, 5], "groups: row 1 is 1.5"),
        ([0, 4, 3, 5], "groups: row 2 is 3"),
        ([0, 4], "groups: from 0 to 4, which are not all 5 points"),
        ([1, 5], "groups: from 1 to 5"),
        ([0, np.nan, 5], "groups: row 1"),
        ("ab", "groups"),
    ):
        with pytest.raises(gk.InputError, match=message):
            NeighborGrid(POINTS, 1.0, groups=groups, device="cpu")
    grid, plain = (NeighborGrid(POINTS, 1.0, groups=groups, device="cpu") for groups in (GROUPS, None))
    for ask in (grid.count, grid.radius_search, grid.radius_search_blocks, grid.knn, grid.hybrid):
        with pytest.raises(gk.InputError, match=r"groups: the grid has 3; give the offsets \(4,\) of the queries"):
            ask(QUERIES)
        with pytest.raises(gk.InputError, match="groups: the points themselves have those of the grid"):
            ask(groups=GROUPS)
        with pytest.raises(gk.InputError, match="groups: 1 are not the 3 of the grid"):
            ask(QUERIES, groups=[0, 3])
        with pytest.raises(gk.InputError, match="not all 3 queries"):
            ask(QUERIES, groups=[0, 1, 2, 4])
        with pytest.raises(gk.InputError, match="groups: row 1 is 1, of the points 2"):
            ask(POINTS, groups=[0, 1, 2, 5], exclude_self=True)
    for ask in (plain.count, plain.radius_search, plain.radius_search_blocks, plain.knn, plain.hybrid):
        with pytest.raises(gk.InputError, match="groups: the points have none"):
            ask(QUERIES, groups=EACH)
    with pytest.raises(gk.InputError, match=r"groups: a wp\.HashGrid"):
        _ = grid.id


def test_a_small_query_is_not_replayed_for_other_groups():
    grid = NeighborGrid(POINTS, 1.0, groups=GROUPS, device="cpu")
    for groups, counts in ((EACH, [2, 0, 2]), ([0, 3, 3, 3], [2, 2, 2]), ([0, 0, 3, 3], [0, 0, 0])) * 3:
        assert grid.count(QUERIES, groups=groups).tolist() == counts
