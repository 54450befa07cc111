"""Groups of points: every answer has the bits of a grid over the group alone."""

from __future__ import annotations

import itertools
from unittest import mock

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from geokit.core import launcher
from geokit.core.scan import row_offsets
from geokit.points import NeighborGrid
from geokit.points.search import nearest as _nearest
from geokit.points.search import radius as radius_search
from geokit.points.search.cells_kernels import GATHER_GROUPS
from geokit.points.search.radius_cuda_kernels import count_in_groups_kernel, fill_in_groups_kernel
from tests.support.devices import DEVICES
from tests.support.effort import of_all

relaxed = settings(deadline=None, max_examples=of_all(12, 25))


def packed(random, count, most):
    """Offsets of ``count`` groups of up to ``most`` rows, some without any."""
    sizes = random.integers(0, most + 1, count) * (random.random(count) < 0.8)
    return np.concatenate([[0], np.cumsum(sizes)])


@st.composite
def batches(draw, most=120):
    """Groups of one of several kinds, in one place or far apart, and queries in and around them."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    groups = packed(random, draw(st.integers(1, 12)), most)
    queries = packed(random, len(groups) - 1, 40)
    kind = draw(st.sampled_from(["uniform", "lattice", "plane", "duplicates", "outlier", "single"]))
    points, asked = random.random((groups[-1], 3)), random.random((queries[-1], 3))
    if kind == "lattice":
        points, asked = np.floor(points * 5) / 4, np.floor(asked * 5) / 4
    if kind == "plane":
        points[:, 1] = 0.5
    if kind == "duplicates":
        points = points[random.integers(0, max(1, len(points) // 9), len(points))] if len(points) else points
    if kind == "outlier" and len(points):
        points[random.integers(0, len(points), 3)] *= 1e7
    apart = random.normal(size=(len(groups) - 1, 3)) * draw(st.sampled_from([0.0, 1.0, 1e6]))
    points += np.repeat(apart, np.diff(groups), axis=0)
    asked += np.repeat(apart, np.diff(queries), axis=0)
    if kind == "single":
        points, asked = points.astype(np.float32), asked.astype(np.float32)
    return points, groups, asked, queries


def assert_rows(found, begin, end, alone, first):
    """Rows ``begin .. end - 1`` of the neighbors are those of a grid alone, whose point 0 is ``first``."""
    part = slice(found.offsets[begin], found.offsets[end])
    np.testing.assert_array_equal(np.diff(found.offsets[begin : end + 1]), np.diff(alone.offsets))
    np.testing.assert_array_equal(found.indices[part], alone.indices + first)
    np.testing.assert_array_equal(found.distance[part], alone.distance)


def assert_nearest(found, begin, end, alone, first):
    np.testing.assert_array_equal(found.indices[begin:end], np.where(alone.indices < 0, -1, alone.indices + first))
    np.testing.assert_array_equal(found.distance[begin:end], alone.distance)


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@relaxed
@given(batches(), st.sampled_from([0.0, 0.01, 0.3, 3.0]), st.sampled_from([1, 5, 40]))
def test_the_answers_are_those_of_a_loop(device, batch, radius, k):
    points, groups, asked, queries = batch
    grid = NeighborGrid(points, radius, groups=groups, device=device)
    own, theirs = grid.radius_search(exclude_self=True), grid.radius_search(asked, groups=queries, order="distance")
    wide = grid.radius_search(asked, groups=queries, radius=7.0 * radius + 0.1)
    counts, pairs = grid.count(asked, groups=queries), grid.pairs()
    near, within = grid.knn(k=k, exclude_self=True), grid.hybrid(asked, k, groups=queries)
    paired = []
    for group, first in enumerate(groups[:-1]):
        part, some = slice(first, groups[group + 1]), slice(queries[group], queries[group + 1])
        alone = NeighborGrid(points[part], radius, device=device)
        assert_rows(own, part.start, part.stop, alone.radius_search(exclude_self=True), first)
        assert_rows(theirs, some.start, some.stop, alone.radius_search(asked[some], order="distance"), first)
        assert_rows(wide, some.start, some.stop, alone.radius_search(asked[some], radius=7.0 * radius + 0.1), first)
        np.testing.assert_array_equal(counts[some], alone.count(asked[some]))
        assert_nearest(near, part.start, part.stop, alone.knn(k=k, exclude_self=True), first)
        assert_nearest(within, some.start, some.stop, alone.hybrid(asked[some], k), first)
        paired.append(alone.pairs().indices + first)
    np.testing.assert_array_equal(pairs.indices, np.concatenate(paired))


@pytest.mark.slow
@pytest.mark.parametrize("spread", [1.0, 1e9])
def test_large_groups_have_intervals_of_cells(spread):
    # Beside small ones, and with a point so far away that equal cells would hold all others in one.
    random = np.random.default_rng(1)
    groups = np.cumsum([0, 5000, 30, 6000, 0, 9000])
    points = random.random((groups[-1], 3))
    points[[7, 5100, 12000]] *= spread
    grid = NeighborGrid(points, 0.08, groups=groups, device="cpu")
    found = grid.radius_search()
    for first, end in itertools.pairwise(groups):
        assert_rows(found, first, end, NeighborGrid(points[first:end], 0.08, device="cpu").radius_search(), first)
    if spread > 1.0:
        starts = grid._cells.grid.start.numpy()
        assert np.diff(starts).max() < 1000


@pytest.mark.slow
@relaxed
@given(batches(), st.sampled_from([1, 12, 30, 70]))
def test_the_search_for_gpus_gives_the_same_bits(batch, k):
    points, groups, asked, queries = batch
    points, asked = points.astype(np.float64), asked.astype(np.float64)
    grid = NeighborGrid(points, 0.3, groups=groups, device="cpu")
    wide = grid.knn(k=k), grid.hybrid(asked, k, groups=queries)

    class Gpu:
        is_cpu = False

    chosen = _nearest._search_kernel
    with mock.patch.object(_nearest, "_search_kernel", lambda k, count, _: chosen(k, count, Gpu)):
        grid._cache.clear()
        narrow = grid.knn(k=k), grid.hybrid(asked, k, groups=queries)
    for a, b in zip(wide, narrow, strict=True):
        np.testing.assert_array_equal(a.indices, b.indices)
        np.testing.assert_array_equal(a.distance, b.distance)
    if len(asked) == 0 or len(points) == 0:
        return
    # The kernels of the radius search run on any device too; the float32 copy is one that only a GPU has.
    whole = grid.radius_search(asked, groups=queries, order="any")
    question, _ = grid._ask(asked, None, False, queries)
    ((cells, sorted_queries, number),) = question.parts
    device = launcher.resolve_device("cpu")
    cells.packed = wp.empty(len(points), dtype=wp.vec4f, device="cpu")
    given_points = wp.array(points, dtype=wp.vec3d, device="cpu")
    launcher.launch(GATHER_GROUPS[wp.vec3d], len(points), [given_points, cells.index], [cells], device)
    counts = wp.empty(len(asked), dtype=wp.int32, device="cpu")
    launcher.launch(count_in_groups_kernel, number, [sorted_queries, cells, question.radius, 0], [counts], device)
    np.testing.assert_array_equal(counts.numpy(), np.diff(whole.offsets))
    indices = wp.empty(len(whole.indices), dtype=wp.int32, device="cpu")
    distance = wp.empty(len(whole.indices), dtype=wp.float64, device="cpu")
    put = [sorted_queries, cells, question.radius, radius_search.NOTHING_LEFT_OUT, row_offsets(counts)]
    launcher.launch(fill_in_groups_kernel, number, put, [indices, distance], device)
    np.testing.assert_array_equal(indices.numpy(), whole.indices)
    np.testing.assert_array_equal(distance.numpy(), whole.distance)
