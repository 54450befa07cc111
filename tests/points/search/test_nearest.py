"""The k nearest points on hand-sized inputs: order, ties, gaps, limits, and every error."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest
import warp as wp

from geokit.core.memory import available_memory
from geokit.errors import DeviceMemoryError, InputError
from geokit.points.search import nearest as _nearest
from geokit.points.search.nearest import MAX_K, KNearest, nearest, require_k
from geokit.points.search.nearest_tree import build_tree
from geokit.points.search.nearest_tree_kernels import LEAF
from tests.support.reference import k_nearest

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [3, 0, 0], [0, 0, -2]])


def rows_of(points):
    return wp.array(np.asarray(points, dtype=np.float64).reshape(-1, 3), dtype=wp.vec3d, device="cpu")


def ask(points, k, queries=None, **options):
    found = nearest(build_tree(rows_of(points)), k, None if queries is None else rows_of(queries), **options)
    return KNearest(*(out.numpy() for out in found))


def assert_exact(points, k, queries=None, *, limit_squared=np.inf, exclude_self=False):
    """Indices and distances are those of all distances, sorted."""
    limit = limit_squared if np.ndim(limit_squared) == 0 else wp.array(limit_squared, dtype=wp.float64, device="cpu")
    found = ask(points, k, queries, limit_squared=limit, exclude_self=exclude_self)
    wanted = k_nearest(
        np.asarray(points, dtype=float).reshape(-1, 3),
        k,
        None if queries is None else np.asarray(queries, dtype=float),
        limit_squared=limit_squared,
        exclude_self=exclude_self,
    )
    np.testing.assert_array_equal(found.indices, wanted[1])
    np.testing.assert_array_equal(found.distance, wanted[0])
    return found


def test_a_hand_made_set():
    found = ask(CORNERS, 3, [[0, 0, 0], [2.5, 0, 0]])
    assert found.indices.tolist() == [[0, 1, 2], [3, 1, 0]]
    assert found.distance.tolist() == [[0.0, 1.0, 1.0], [0.5, 1.5, 2.5]]
    assert (found.distance.dtype, found.indices.dtype) == (np.float64, np.int32)


def test_its_own_points():
    assert ask(CORNERS, 1).indices[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert ask(CORNERS, 1, exclude_self=True).indices[:, 0].tolist() == [1, 0, 0, 1, 0]


def test_fewer_points_than_wanted():
    found = ask(CORNERS[:2], 4, [[0, 0, 0]])
    assert found.indices.tolist() == [[0, 1, -1, -1]]
    assert found.distance.tolist() == [[0.0, 1.0, np.inf, np.inf]]
    alone = ask(CORNERS[:1], 2, exclude_self=True)
    assert alone.indices.tolist() == [[-1, -1]]
    assert alone.distance.tolist() == [[np.inf, np.inf]]


def test_no_points_and_no_queries():
    none = ask(np.zeros((0, 3)), 3, CORNERS)
    assert none.indices.tolist() == [[-1, -1, -1]] * 5
    assert np.isinf(none.distance).all()
    assert ask(np.zeros((0, 3)), 3).indices.shape == (0, 3)
    assert ask(CORNERS, 3, np.zeros((0, 3))).indices.shape == (0, 3)


def test_the_ball_is_closed():
    found = ask(CORNERS, 4, [[0, 0, 0]], limit_squared=1.0)
    assert found.indices.tolist() == [[0, 1, 2, -1]]
    assert found.distance.tolist() == [[0.0, 1.0, 1.0, np.inf]]
    assert ask(CORNERS, 4, [[0, 0, 0]], limit_squared=np.nextafter(1.0, 0.0)).indices.tolist() == [[0, -1, -1, -1]]
    assert ask(CORNERS, 4, [[0.5, 0, 0]], limit_squared=0.0).indices.tolist() == [[-1, -1, -1, -1]]
    assert ask(CORNERS, 2, limit_squared=0.0).indices[:, 0].tolist() == [0, 1, 2, 3, 4]


def test_a_limit_for_each_query():
    limits = np.array([0.0, 1.0, 2.0, 4.0, np.inf])
    found = assert_exact(CORNERS, 5, limit_squared=limits)
    assert (found.indices >= 0).sum(axis=1).tolist() == [1, 2, 3, 2, 5]


@pytest.mark.slow
@pytest.mark.parametrize("k", [1, 2, 7, 8, 9, 15, 16, 17, 31, 32, 33, 48, 100, 255, 256, 257, 700, 1024])
def test_every_length_of_list(k):
    random = np.random.default_rng(k)
    points = random.random((1300, 3))
    assert_exact(points, k, random.random((70, 3)) * 3 - 1)
    assert_exact(points[: k + 20], k)


@pytest.mark.parametrize("count", [1, 2, 15, 16, 17, 127, 128, 129, 130, 1025])
def test_every_number_of_points(count):
    points = np.random.default_rng(count).random((count, 3))
    assert_exact(points, 5)
    assert_exact(points, 20, exclude_self=True)


@pytest.mark.slow
@pytest.mark.parametrize("k", [1, 6, 8, 19, 32, 60, 300])
def test_ties_on_a_lattice_go_to_the_lowest_index(k):
    axis = np.arange(9.0)
    lattice = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    shuffled = lattice[np.random.default_rng(3).permutation(len(lattice))]
    assert_exact(shuffled, k)
    assert_exact(shuffled, k, exclude_self=True)
    # The middles of cells are equally far from eight corners.
    assert_exact(shuffled, k, lattice[:100] + 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("k", [1, 3, 16, 40])
def test_equal_points(k):
    points = np.full((1000, 3), 0.25)
    found = assert_exact(points, k)
    assert (found.indices == np.arange(k)).all()
    # Only the point itself is left out, not those that lie where it does.
    without = assert_exact(points, k, exclude_self=True)
    assert without.indices[0].tolist() == list(range(1, k + 1))
    assert without.indices[k + 5].tolist() == list(range(k))
    assert (without.distance == 0.0).all()


@pytest.mark.slow
def test_duplicates():
    random = np.random.default_rng(5)
    points = random.random((40, 3))[random.integers(0, 40, 2000)]
    for exclude_self in (False, True):
        assert_exact(points, 9, exclude_self=exclude_self)
        assert_exact(points, 70, exclude_self=exclude_self)


def test_lines_and_planes():
    points = np.random.default_rng(6).random((1500, 3)) - 0.5
    assert_exact(points * [1, 1, 0], 12)
    assert_exact(points * [0, 1, 0], 12)
    assert_exact(points * [1, 1e-7, 1], 12)


def test_queries_far_outside():
    random = np.random.default_rng(7)
    points = random.random((900, 3))
    directions = random.normal(size=(60, 3))
    for far in (3.0, 1e3, 1e9, 1e200):
        assert_exact(points, 10, directions * far)


def test_distances_that_overflow():
    found = ask([[1e200, 0, 0], [-1e200, 0, 0], [0, 0, 0]], 3, [[0, 0, 0], [1.7e308, 0, 0]])
    assert found.indices.tolist() == [[2, 0, 1], [0, 1, 2]]
    assert found.distance.tolist() == [[0.0, np.inf, np.inf], [np.inf, np.inf, np.inf]]


def test_k_out_of_range():
    for k in (0, -3, MAX_K + 1):
        with pytest.raises(InputError, match=rf"k: {k} is not from 1 to {MAX_K}"):
            require_k(k)
    for k in (1.5, "8", None):
        with pytest.raises(InputError, match="is not a whole number; give one from 1 to"):
            require_k(k)
    assert require_k(np.int64(7)) == 7


def test_answers_that_do_not_fit():
    tree = build_tree(rows_of(CORNERS))
    with (
        mock.patch.object(available_memory, "available", return_value=5 * 3 * _nearest.BYTES_PER_NEIGHBOR - 1),
        pytest.raises(DeviceMemoryError, match="knn: the 3 nearest points of 5 queries"),
    ):
        nearest(tree, 3, None)


def test_a_leaf_is_a_run_of_near_points():
    # Searches are fast because leaves hardly overlap. In a random order each leaf would fill the whole cube.
    points = np.random.default_rng(8).random((4096, 3))
    tree = build_tree(rows_of(points))
    blocks = tree.positions.numpy().reshape(-1, 3, int(LEAF))
    assert sorted(tree.index.numpy().tolist()) == list(range(4096))
    volume = np.prod(blocks.max(axis=2) - blocks.min(axis=2), axis=1).sum()
    assert volume < 2.0
