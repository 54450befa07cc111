"""Normals, density, outliers and clusters on random inputs: their definitions, and invariances of the results."""

from __future__ import annotations

import itertools
import os
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from geokit.points._cluster import cluster
from geokit.points._density import density
from geokit.points._normals import normals
from geokit.points._outliers import outliers
from tests.support.effort import of_all
from tests.support.reference import density_clusters

# The first call of a process loads the kernels, which takes longer than any single example.
relaxed = settings(deadline=None, max_examples=of_all(15, 30))

AXES = list(itertools.permutations(range(3)))
# The docstring gives some 1e-13 for the gaps of these surfaces, and rotated coordinates are rounded; sums need less.
CLOSE_NORMALS = 1e-10
CLOSE_SUMS = 1e-13


@st.composite
def clouds(draw):
    """Points of one of several kinds, with a radius that has something to find."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(1, 300))
    kind = draw(st.sampled_from(["uniform", "lattice", "clusters", "plane", "outlier"]))
    if kind == "lattice":
        points = random.integers(0, 6, (count, 3)).astype(float)
    elif kind == "clusters":
        points = random.random((4, 3))[random.integers(0, 4, count)] + random.normal(size=(count, 3)) * 1e-2
    else:
        points = random.random((count, 3))
        if kind == "plane":
            points[:, draw(st.integers(0, 2))] = 0.5
        if kind == "outlier":
            points[0] = draw(st.sampled_from([1e3, 1e7, -1e15]))
    radius = draw(st.sampled_from([0.02, 0.1, 0.2, 1.0, np.sqrt(2.0), 3.0]))
    return points, radius, random


def surfaces(random, count):
    """Points of a bumpy surface, in random order, whose neighborhoods have a unique best plane."""
    uv = random.random((count, 2))
    height = 0.1 * np.sin(5.0 * uv[:, 0]) * np.cos(4.0 * uv[:, 1])
    return np.column_stack([uv, height])


def rotation(random):
    q, r = np.linalg.qr(random.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


@relaxed
@given(clouds(), st.integers(1, 12))
def test_clusters_equal_the_definition(cloud, minimum_count):
    points, radius, _ = cloud
    found = cluster(points, radius=radius, minimum_count=minimum_count, device="cpu")
    np.testing.assert_array_equal(found, density_clusters(points, radius, minimum_count))


@relaxed
@given(clouds(), st.integers(2, 6))
def test_clusters_do_not_depend_on_the_order(cloud, minimum_count):
    points, radius, random = cloud
    shuffle = random.permutation(len(points))
    base = cluster(points, radius=radius, minimum_count=minimum_count, device="cpu")
    other = cluster(points[shuffle], radius=radius, minimum_count=minimum_count, device="cpu")
    np.testing.assert_array_equal(other < 0, base[shuffle] < 0)
    counts = (cKDTree(points).query_ball_point(points, radius, return_length=True) >= minimum_count)[shuffle]
    # The same partition of the core points, under other numbers; borders may be equally near to two of them.
    pairs = set(zip(other[counts].tolist(), base[shuffle][counts].tolist(), strict=True))
    assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})


@pytest.mark.slow
@relaxed
@given(clouds(), st.sampled_from([2.0**-30, 2.0**30]), st.sampled_from(AXES))
def test_clusters_and_outliers_under_motions_that_round_nothing(cloud, scale, axes):
    points, radius, _ = cloud
    moved = -points[:, axes] * scale
    np.testing.assert_array_equal(
        cluster(moved, radius=radius * scale, device="cpu"), cluster(points, radius=radius, device="cpu")
    )
    np.testing.assert_array_equal(
        outliers(moved, method="radius", radius=radius * scale, minimum_count=3, device="cpu"),
        outliers(points, method="radius", radius=radius, minimum_count=3, device="cpu"),
    )


@relaxed
@given(clouds(), st.integers(1, 20), st.sampled_from([0.0, 0.5, 1.0, 2.5]))
def test_statistical_outliers_equal_the_definition(cloud, k, ratio):
    points, _, _ = cloud
    found = outliers(points, k=k, ratio=ratio, device="cpu")
    if len(points) == 1:
        assert not found.any()
        return
    # The point is the first of its own neighbors; ones in the same place are as far.
    distance = np.sort(cKDTree(points).query(points, min(k + 1, len(points)))[0], axis=1)[:, 1:]
    mean = distance.mean(axis=1)
    threshold = mean.mean() + ratio * mean.std(ddof=1)
    # Sums in another order move the threshold by a few roundings: no point may be that near and still decide the test.
    clear = np.abs(mean - threshold) > 1e-12 * mean.max()
    np.testing.assert_array_equal(found[clear], (mean > threshold)[clear])


@pytest.mark.slow
@relaxed
@given(clouds(), st.sampled_from(["count", "cubic_spline", "wendland_c2", "poly6"]))
def test_density_does_not_depend_on_order_or_on_how_it_is_asked(cloud, kernel):
    points, radius, random = cloud
    base = density(points, radius=radius, kernel=kernel, device="cpu")
    shuffle = random.permutation(len(points))
    np.testing.assert_array_equal(
        density(points, radius=radius, kernel=kernel, queries=points[shuffle], device="cpu"), base[shuffle]
    )
    other = density(points[shuffle], radius=radius, kernel=kernel, device="cpu")
    np.testing.assert_allclose(other, base[shuffle], rtol=CLOSE_SUMS)
    scaled = density(-points * 4.0, radius=radius * 4.0, kernel=kernel, mass=64.0, device="cpu")
    np.testing.assert_allclose(scaled, base, rtol=CLOSE_SUMS)
    # Every point sees itself.
    assert (base > 0.0).all()


@relaxed
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1.0, 1e3]), st.sampled_from([1e-6, 1.0, 1e6]))
def test_normals_turn_with_the_points(seed, offset, scale):
    random = np.random.default_rng(seed)
    points = surfaces(random, 400)
    turn, shuffle = rotation(random), random.permutation(400)
    base = normals(points, k=12, orientation="none", device="cpu")
    moved = (points @ turn.T + offset) * scale
    other = normals(moved[shuffle], k=12, orientation="none", device="cpu")
    sine = np.linalg.norm(np.cross(other.normals, base.normals[shuffle] @ turn.T), axis=1)
    # An offset of a thousand takes three digits from the coordinates, which neighborhoods of a tenth see ten times.
    assert sine.max() <= CLOSE_NORMALS * max(offset, 1.0)
    np.testing.assert_allclose(other.curvature, base.curvature[shuffle], atol=CLOSE_NORMALS * max(offset, 1.0))


@relaxed
@given(st.integers(0, 2**32 - 1), st.integers(6, 20))
def test_signs_agree_with_the_surface_s(seed, k):
    random = np.random.default_rng(seed)
    points = surfaces(random, 400)
    found = normals(points, k=k, device="cpu").normals
    # The surface is a height field: its normals all are upwards.
    assert (found[:, 2] > 0.0).all()
    eye = np.array([0.5, 0.5, 9.0])
    np.testing.assert_array_equal(
        normals(points, k=k, orientation="viewpoint", viewpoint=eye, device="cpu").normals, found
    )


@relaxed
@given(clouds(), st.integers(3, 20))
def test_normals_are_unit_vectors_or_zeros(cloud, k):
    points, radius, _ = cloud
    for found in (normals(points, k=k, device="cpu"), normals(points, k=k, radius=radius, device="cpu")):
        length = np.linalg.norm(found.normals, axis=1)
        assert np.isfinite(found.normals).all()
        assert ((np.abs(length - 1.0) < 1e-15) | (length == 0.0)).all()
        assert ((found.curvature >= 0.0) & (found.curvature <= 1.0 / 3.0 + 1e-15)).all()
        # Curvature is that of a plane only where there is one.
        assert not found.curvature[length == 0.0].any()


@pytest.mark.slow
@pytest.mark.parametrize("threads", ["1", "2", "3"])
def test_threads_change_nothing(threads):
    random = np.random.default_rng(0)
    points = np.concatenate([surfaces(random, 6000), random.random((3000, 3))])

    def answers():
        return [
            *normals(points, device="cpu"),
            normals(points, radius=0.05, device="cpu").normals,
            density(points, radius=0.05, kernel="poly6", device="cpu"),
            outliers(points, device="cpu"),
            cluster(points, radius=0.03, device="cpu"),
        ]

    base = answers()
    with mock.patch.dict(os.environ, {"GEOKIT_THREADS": threads}):
        for found, wanted in zip(answers(), base, strict=True):
            np.testing.assert_array_equal(found, wanted)
