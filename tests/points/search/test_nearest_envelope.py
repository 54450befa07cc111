"""Nearest neighbors pushed towards failure: scale, offset, outliers, crowds of all kinds, and the work they cost."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from geokit.points.search.nearest import nearest
from geokit.points.search.nearest_tree import build_tree
from geokit.points.search.nearest_tree_kernels import LEAF
from tests.support.effort import spread
from tests.support.reference import k_nearest

POINTS = np.random.default_rng(21).random((1500, 3)) - 0.5


def tree_of(points):
    return build_tree(wp.array(points, dtype=wp.vec3d, device="cpu"))


def assert_exact(points, k):
    found = nearest(tree_of(points), k, None)
    wanted = k_nearest(points, k)
    np.testing.assert_array_equal(found[1].numpy(), wanted[1])
    np.testing.assert_array_equal(found[0].numpy(), wanted[0])


def leaves_per_query(points, k, queries=500):
    """Leaves that may hold an answer: those whose box is within the k-th distance, replayed in NumPy."""
    tree = tree_of(points)
    distance = nearest(tree, k, None)[0].numpy()[:, -1]
    blocks = tree.positions.numpy().reshape(-1, 3, int(LEAF))
    lower, upper = np.nanmin(blocks, axis=2), np.nanmax(blocks, axis=2)
    opened = 0
    for i in np.random.default_rng(0).choice(len(points), queries, replace=False):
        outside = np.maximum(np.maximum(lower - points[i], points[i] - upper), 0.0)
        opened += (np.linalg.norm(outside, axis=1) <= distance[i]).sum()
    return opened / queries


def crowd(kind, count):
    random = np.random.default_rng(22)
    points = random.random((count, 3))
    if kind == "half in a hundredth":
        points[: count // 2] = 0.4 + points[: count // 2] * 0.01 ** (1 / 3)
    if kind == "half in 1e-12":
        points[: count // 2] = 0.4 + points[: count // 2] * 1e-4
    if kind == "line":
        points[:, 1:] = 0.5
    if kind == "diagonal":
        points[:] = points[:, :1]
    if kind == "plane":
        points[:, 2] = 0.5
    if kind == "thin":
        points[:, 2] *= 1e-6
    if kind == "sphere":
        points -= 0.5
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    if kind == "far point":
        points[0] = 1e9
    if kind == "far points":
        points[:20] *= np.geomspace(1e3, 1e300, 20)[:, None]
    if kind == "far bunches":
        points = random.random((30, 3))[random.integers(0, 30, count)] * 1e9 + points * 1e-3
    if kind == "heavy tails":
        points = random.standard_cauchy((count, 3))
    if kind == "geometric":
        points *= np.exp(-40.0 * random.random((count, 1)))
    return points


@pytest.mark.slow
@pytest.mark.parametrize("scale", spread([1e-150, 1e-6, 1e-3, 1.0, 1e3, 1e9, 1e150], 3))
def test_scale(scale):
    assert_exact(POINTS * scale, 8)


@pytest.mark.slow
@pytest.mark.parametrize("offset", spread([1.0, 1e3, 1e6, 1e9, 1e15, 1e17], 3))
def test_offset(offset):
    # The last ones leave few different coordinates, or a single one: nothing but ties.
    assert_exact(POINTS + offset, 8)
    assert_exact(POINTS - [offset, 0, 0], 8)


@pytest.mark.slow
@pytest.mark.parametrize("aspect", spread([1e-3, 1e-9, 1e-15, 1e-300, 0.0], 3))
def test_flat_and_thin(aspect):
    assert_exact(POINTS * [1, 1, aspect], 8)
    assert_exact(POINTS * [1, aspect, aspect], 8)


@pytest.mark.slow
@pytest.mark.parametrize("far", [1e3, 1e9, 1e100, 1.7e308])
def test_far_points(far):
    points = POINTS.copy()
    points[7] = far
    points[8, 1] = -far
    assert_exact(points, 8)


@pytest.mark.slow
def test_squares_that_underflow():
    # Squares of differences below 1e-162 are zero: such points count as equal, and the index decides.
    assert_exact(POINTS * 1e-165, 8)
    assert_exact(np.vstack([POINTS * 1e-165, POINTS]), 8)


KINDS = [
    "half in a hundredth",
    "half in 1e-12",
    "line",
    "diagonal",
    "plane",
    "thin",
    "sphere",
    "far point",
    "far points",
    "far bunches",
    "heavy tails",
    "geometric",
]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_crowds_are_exact(kind):
    points = crowd(kind, 1000)
    assert_exact(points, 8)
    assert_exact(points, 40)


# Leaves of 16 that a query with k = 8 opens at most, on average over evenly spread points. What a leaf costs does not
# depend on where the points are: twice as many are twice the time.
EVEN_LEAVES = 9.0


def test_work_of_evenly_spread_points():
    assert leaves_per_query(crowd("uniform", 30_000), 8) < EVEN_LEAVES


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_work_of_crowds(kind):
    # A leaf over several crowds overlaps many others, but few leaves are over several.
    assert leaves_per_query(crowd(kind, 30_000), 8) < 2.0 * EVEN_LEAVES


@pytest.mark.slow
@pytest.mark.parametrize("count", spread([2_000, 20_000, 200_000], 2))
def test_work_does_not_grow_with_the_number_of_points(count):
    assert leaves_per_query(crowd("half in a hundredth", count), 8, queries=200) < EVEN_LEAVES


def test_work_with_many_equal_points():
    # A hundred places with 300 points each: each place has 19 leaves, which all are at distance 0. Ties are settled by
    # the leaves' lowest indices, so that searching stays quick; what is asserted is the answer.
    random = np.random.default_rng(23)
    places = random.random((100, 3))
    points = places[random.integers(0, 100, 30_000)]
    found = nearest(tree_of(points), 8, None)
    assert (found[0].numpy() == 0.0).all()
    label = np.unique(points, axis=0, return_inverse=True)[1].ravel()
    first = {place: np.flatnonzero(label == place)[:8] for place in range(100)}
    np.testing.assert_array_equal(found[1].numpy(), np.array([first[place] for place in label]))
