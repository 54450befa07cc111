"""NeighborGrid against scipy's tree and the plain reference on random inputs, and invariances of the results."""

from __future__ import annotations

import itertools
import os
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from geokit.points import NeighborGrid
from tests.support.effort import of_all
from tests.support.reference import neighbors_within

# The first call of a process loads the kernels, which takes longer than any single example.
relaxed = settings(deadline=None, max_examples=of_all(20, 40))

SIGNATURES = list(itertools.permutations(range(3)))


def rows(found):
    return [found.indices[a:b].tolist() for a, b in itertools.pairwise(found.offsets)]


@st.composite
def clouds(draw):
    """Points of one of several kinds, with a radius that has something to find."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(1, 300))
    kind = draw(st.sampled_from(["uniform", "lattice", "clusters", "plane", "outlier"]))
    if kind == "lattice":
        points = random.integers(0, 6, (count, 3)).astype(float)
    elif kind == "clusters":
        points = random.random((4, 3))[random.integers(0, 4, count)] + random.normal(size=(count, 3)) * 1e-4
    else:
        points = random.random((count, 3))
        if kind == "plane":
            points[:, draw(st.integers(0, 2))] = 0.5
        if kind == "outlier":
            points[0] = draw(st.sampled_from([1e3, 1e7, 1e15, -1e290]))
    radius = draw(st.sampled_from([1e-4, 0.05, 0.2, 1.0, 2.0, np.sqrt(2.0), 3.0, 40.0]))
    return points, radius, random


@pytest.mark.slow
@relaxed
@given(clouds(), st.sampled_from([0.3, 1.0, 1.9, 7.0]))
def test_equals_scipy(cloud, ratio):
    points, radius, random = cloud
    queries = np.concatenate([points[:20], points[:20] + random.normal(size=(min(len(points), 20), 3)) * radius])
    # scipy's tree overflows on coordinates of 1e290; the reference of the next test does not need one.
    if np.abs(points).max() > 1e100:
        points, queries = points[1:], queries[np.abs(queries).max(axis=1) < 1e100]
        if len(points) == 0:
            return
    found = NeighborGrid(points, radius * ratio, device="cpu").radius_search(queries, radius=radius)
    assert rows(found) == [list(row) for row in cKDTree(points).query_ball_point(queries, radius, return_sorted=True)]


@pytest.mark.slow
@relaxed
@given(clouds())
def test_equals_the_formula(cloud):
    points, radius, _ = cloud
    with np.errstate(over="ignore"):
        d = points[:, None] - points[None]
        near = (d[..., 0] ** 2 + d[..., 1] ** 2) + d[..., 2] ** 2 <= radius * radius
    found = NeighborGrid(points, radius, device="cpu").radius_search(points)
    assert rows(found) == [np.flatnonzero(row).tolist() for row in near]


@pytest.mark.slow
@relaxed
@given(clouds())
def test_equals_the_reference(cloud):
    points, radius, _ = cloud
    radius = radius * 1.0123456789  # equals no pairwise distance: norms and squares agree
    found = NeighborGrid(points, radius, device="cpu").radius_search(points)
    with np.errstate(over="ignore"):
        assert rows(found) == [row.tolist() for row in neighbors_within(points, points, radius)]


@relaxed
@given(
    clouds(), st.sampled_from([0.0, 1e3, 1e6]), st.sampled_from([2.0**-30, 1.0, 2.0**30]), st.sampled_from(SIGNATURES)
)
def test_rigid_motion_and_scale_that_round_nothing(cloud, offset, scale, axes):
    # Powers of two and swapped axes change no digit; the offset is taken before both sides see the points.
    points, radius, _ = cloud
    points = points + offset
    with np.errstate(over="ignore"):
        moved = -points[:, axes] * scale
    base = NeighborGrid(points, radius, device="cpu").radius_search(points, radius=radius * 0.99123)
    other = NeighborGrid(moved, radius * scale, device="cpu").radius_search(moved, radius=radius * scale * 0.99123)
    assert rows(other) == rows(base)
    np.testing.assert_allclose(other.distance, base.distance * scale, rtol=1e-15)


@relaxed
@given(clouds())
def test_order_of_points_and_queries(cloud):
    points, radius, random = cloud
    shuffle, turn = random.permutation(len(points)), random.permutation(len(points))
    base = rows(NeighborGrid(points, radius, device="cpu").radius_search(points))
    other = rows(NeighborGrid(points[shuffle], radius, device="cpu").radius_search(points[turn]))
    for at, query in enumerate(turn):
        assert sorted(shuffle[other[at]].tolist()) == base[query]
        assert other[at] == sorted(other[at])


@pytest.mark.slow
@relaxed
@given(clouds())
def test_neighborhood_is_mutual_and_every_point_is_its_own(cloud):
    points, radius, _ = cloud
    found = NeighborGrid(points, radius, device="cpu").radius_search(points)
    owner = np.repeat(np.arange(len(points)), np.diff(found.offsets))
    pairs = set(zip(owner.tolist(), found.indices.tolist(), strict=True))
    assert pairs == {(b, a) for a, b in pairs}
    assert {(i, i) for i in range(len(points))} <= pairs
    assert (found.distance[owner == found.indices] == 0.0).all()


@pytest.mark.slow
@relaxed
@given(clouds())
def test_more_radius_finds_no_fewer(cloud):
    points, radius, _ = cloud
    grid = NeighborGrid(points, radius, device="cpu")
    counts = [grid.count(points, radius=radius * factor) for factor in (0.5, 1.0, 1.5, 4.0)]
    assert all((a <= b).all() for a, b in itertools.pairwise(counts))


@pytest.mark.parametrize("threads", ["1", "2", "3"])
def test_threads_change_nothing(threads):
    # More queries than one slice and than the ordering threshold.
    points = np.random.default_rng(0).random((6000, 3))
    wanted = cKDTree(points).query_ball_point(points, 0.05, return_sorted=True)
    with mock.patch.dict(os.environ, {"GEOKIT_THREADS": threads}):
        found = NeighborGrid(points, 0.05, device="cpu").radius_search(points)
    np.testing.assert_array_equal(found.offsets, np.cumsum([0, *map(len, wanted)]))
    np.testing.assert_array_equal(found.indices, np.concatenate(wanted))
