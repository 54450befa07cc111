"""The k nearest points against plain references on random inputs, and invariances of the results."""

from __future__ import annotations

import itertools
import os
from unittest import mock

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from geokit.points.search import nearest as _nearest
from geokit.points.search import nearest_cuda_kernels
from geokit.points.search.nearest import nearest
from geokit.points.search.nearest_tree import build_tree
from tests.support.effort import of_all
from tests.support.reference import k_nearest

# The first call of a process loads the kernels, which takes longer than any single example.
relaxed = settings(deadline=None, max_examples=of_all(20, 40))

LENGTHS = [1, 3, 8, 13, 16, 20, 32, 33, 64, 150]


def ask(points, k, queries=None, **options):
    def rows_of(values):
        return wp.array(values, dtype=wp.vec3d, device="cpu")

    limit = options.pop("limit_squared", np.inf)
    if np.ndim(limit):
        limit = wp.array(limit, dtype=wp.float64, device="cpu")
    tree = build_tree(rows_of(points))
    found = nearest(tree, k, None if queries is None else rows_of(queries), limit_squared=limit, **options)
    return found[0].numpy(), found[1].numpy()


def assert_equal(found, wanted):
    np.testing.assert_array_equal(found[1], wanted[1])
    np.testing.assert_array_equal(found[0], wanted[0])


@st.composite
def clouds(draw):
    """Points of one of several kinds, and queries near them, on them, or far away."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(1, 600))
    kind = draw(st.sampled_from(["uniform", "lattice", "clusters", "plane", "line", "outlier", "duplicates", "heavy"]))
    points = random.random((count, 3)) - 0.5
    if kind == "lattice":
        points = random.integers(0, 6, (count, 3)).astype(float)
    if kind == "clusters":
        points = random.random((4, 3))[random.integers(0, 4, count)] * 1e6 + points * 1e-4
    if kind == "plane":
        points[:, draw(st.integers(0, 2))] = 0.5
    if kind == "line":
        points[:, 1:] = 0.25
    if kind == "outlier":
        points[0] = draw(st.sampled_from([1e3, 1e9, 1e15, -1e290]))
    if kind == "duplicates":
        points = points[random.integers(0, 1 + count // 10, count)]
    if kind == "heavy":
        points = random.standard_cauchy((count, 3))
    query_count = draw(st.integers(1, 200))
    queries = points[random.integers(0, count, query_count)]
    spread = draw(st.sampled_from([0.0, 1e-3, 1.0, 1e4]))
    return points, queries + random.normal(size=queries.shape) * spread, random


@pytest.mark.slow
@relaxed
@given(clouds(), st.sampled_from(LENGTHS), st.booleans())
def test_equals_the_reference(cloud, k, exclude_self):
    points, queries, _ = cloud
    assert_equal(ask(points, k, exclude_self=exclude_self), k_nearest(points, k, exclude_self=exclude_self))
    assert_equal(ask(points, k, queries), k_nearest(points, k, queries))


@pytest.mark.slow
@relaxed
@given(clouds(), st.sampled_from(LENGTHS))
def test_limits_equal_the_reference(cloud, k):
    points, queries, random = cloud
    # Some limits are the very distance of a point: the ball is closed.
    d = queries - points[random.integers(0, len(points), len(queries))]
    with np.errstate(over="ignore"):
        limits = (d[:, 0] ** 2 + d[:, 1] ** 2) + d[:, 2] ** 2
    limits[::3] = random.choice([0.0, 0.01, np.inf], len(limits[::3]))
    assert_equal(ask(points, k, queries, limit_squared=limits), k_nearest(points, k, queries, limit_squared=limits))
    one = float(limits[0])
    assert_equal(ask(points, k, queries, limit_squared=one), k_nearest(points, k, queries, limit_squared=one))


@pytest.mark.slow
@relaxed
@given(st.integers(0, 2**32 - 1), st.sampled_from(LENGTHS))
def test_equals_scipy(seed, k):
    random = np.random.default_rng(seed)
    points, queries = random.random((3000, 3)), random.random((500, 3)) * 2 - 0.5
    for asked in (points, queries):
        distance, indices = cKDTree(points).query(asked, k)
        found = ask(points, k, None if asked is points else asked)
        assert_equal(found, (distance.reshape(found[0].shape), indices.reshape(found[1].shape)))


@pytest.mark.slow
@relaxed
@given(clouds(), st.sampled_from(LENGTHS), st.booleans(), st.sampled_from([1, 40, 8192]))
def test_the_search_for_gpus_gives_the_same_bits(cloud, k, exclude_self, least_teams):
    points, queries, random = cloud
    limits = np.exp(random.normal(size=len(queries)) * 3.0)
    cuts = np.sort(random.integers(0, len(points) + 1, 3))
    groups = np.concatenate([[0], cuts, [len(points)]])

    def answers():
        yield ask(points, k, exclude_self=exclude_self)
        yield ask(points, k, limit_squared=float(limits[0]))
        yield ask(points, k, queries)
        yield ask(points, k, queries, limit_squared=limits)
        rows = wp.array(points, dtype=wp.vec3d, device="cpu")
        tree = build_tree(rows, groups)
        for asked in (None, rows):
            found = nearest(tree, k, asked, groups=(groups, groups), exclude_self=exclude_self)
            yield found[0].numpy(), found[1].numpy()

    class Gpu:
        is_cpu = False

    wide, chosen = list(answers()), _nearest._search_kernel
    with (
        mock.patch.object(_nearest, "_search_kernel", lambda k, count, _: chosen(k, count, Gpu)),
        mock.patch.object(_nearest, "LEAST_TEAMS", least_teams),
    ):
        assert _nearest._search_kernel(k, 1, None)[0].module.name == nearest_cuda_kernels.__name__
        narrow = list(answers())
    for a, b in zip(wide, narrow, strict=True):
        assert_equal(a, b)


@pytest.mark.parametrize("k", [9, 32, 100, 128, 129, 1024])
def test_teams_find_the_nearest_of_many(k):
    """Runs of sixteen queries, crowds, ties and lists for which there is no room at once."""
    random = np.random.default_rng(k)
    crowd = random.random((3000, 3))
    crowd[:1500] = 0.4 + 0.01 * crowd[:1500]
    clouds = [crowd, np.full((2500, 3), 0.5), random.integers(0, 12, (3000, 3)).astype(float)]

    class Gpu:
        is_cpu = False

    chosen = _nearest._search_kernel
    for points in clouds:
        queries = np.concatenate([points[::7], points[::14], random.normal(size=(200, 3)) * 5.0])
        limits = np.exp(random.normal(size=len(queries)) * 3.0)  # of queries at one place too
        wide = ask(points, k), ask(points, k, queries), ask(points, k, queries, limit_squared=limits)
        with (
            mock.patch.object(_nearest, "_search_kernel", lambda k, count, _: chosen(k, count, Gpu)),
            mock.patch.object(_nearest, "LEAST_TEAMS", 1),
        ):
            assert_equal(ask(points, k), wide[0])
            assert_equal(ask(points, k, queries), wide[1])
            assert_equal(ask(points, k, queries, limit_squared=limits), wide[2])


@pytest.mark.slow
@relaxed
@given(clouds(), st.sampled_from(LENGTHS))
def test_permuted_points_and_queries(cloud, k):
    points, queries, random = cloud
    found = ask(points, k, queries)
    order = random.permutation(len(queries))
    assert_equal(ask(points, k, queries[order]), (found[0][order], found[1][order]))
    # Other indices break ties otherwise: the distances stay.
    np.testing.assert_array_equal(ask(points[random.permutation(len(points))], k, queries)[0], found[0])


@relaxed
@given(clouds(), st.sampled_from([1, 8, 33]), st.sampled_from([2.0**-60, 0.5, 2.0**40]))
def test_powers_of_two_scale_the_distances(cloud, k, scale):
    points, queries, _ = cloud
    distance, indices = ask(points, k, queries)
    # Squares of 1e290 overflow, and those of values below 1e-154 underflow: there scaling is not exact.
    if np.abs(points).max() < 1e100:
        assert_equal(ask(points * scale, k, queries * scale), (distance * scale, indices))


@pytest.mark.slow
@relaxed
@given(clouds(), st.sampled_from(LENGTHS), st.integers(1, 3))
def test_signs_and_axes(cloud, k, flips):
    # Mirrored axes leave every square as it is; so does a swap of the two that are added first.
    points, queries, _ = cloud
    signs = np.array([1.0 if flips & 1 else -1.0, 1.0 if flips & 2 else -1.0, -1.0])
    found = ask(points, k, queries)
    assert_equal(ask(points * signs, k, queries * signs), found)
    assert_equal(ask(points[:, [1, 0, 2]], k, queries[:, [1, 0, 2]]), found)


@pytest.mark.slow
@relaxed
@given(clouds())
def test_a_longer_list_begins_with_the_shorter(cloud):
    points, queries, _ = cloud
    longest = ask(points, 150, queries)
    for k, _ in itertools.pairwise(LENGTHS):
        found = ask(points, k, queries)
        assert_equal(found, (longest[0][:, :k], longest[1][:, :k]))


@pytest.mark.parametrize("threads", ["1", "2", "7"])
def test_threads_do_not_matter(threads):
    points = np.random.default_rng(11).random((20_000, 3))
    found = ask(points, 8)
    with mock.patch.dict(os.environ, {"GEOKIT_THREADS": threads}):
        assert_equal(ask(points, 8), found)


def test_inputs_stay_as_they_are():
    points = wp.array(np.random.default_rng(12).random((500, 3)), dtype=wp.vec3d, device="cpu")
    queries = wp.array(np.random.default_rng(13).random((100, 3)), dtype=wp.vec3d, device="cpu")
    before = points.numpy().copy(), queries.numpy().copy()
    nearest(build_tree(points), 5, queries)
    np.testing.assert_array_equal(points.numpy(), before[0])
    np.testing.assert_array_equal(queries.numpy(), before[1])
