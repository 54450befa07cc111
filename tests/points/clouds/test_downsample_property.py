"""downsample against plain loops on random inputs: its guarantees, and invariances of the results."""

from __future__ import annotations

import itertools
import os
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from geokit.points._downsample import downsample
from geokit.points.clouds import voxel_centroids
from tests.support.reference import farthest_point_order, poisson_disk_indices, voxel_means

# The first call of a process loads the kernels, which takes longer than any single example.
relaxed = settings(deadline=None, max_examples=30)


@st.composite
def clouds(draw):
    """Points of one of several kinds, with a length of about their spacing."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(1, 400))
    kind = draw(st.sampled_from(["uniform", "lattice", "clusters", "plane", "outlier", "duplicates"]))
    if kind == "lattice":
        points = random.integers(-3, 4, (count, 3)).astype(float)
    elif kind == "clusters":
        points = random.random((4, 3))[random.integers(0, 4, count)] + random.normal(size=(count, 3)) * 1e-4
    elif kind == "duplicates":
        points = random.normal(size=(9, 3))[random.integers(0, 9, count)]
    else:
        points = random.normal(size=(count, 3))
        if kind == "plane":
            points[:, draw(st.integers(0, 2))] = 0.5
        if kind == "outlier":
            points[0] = draw(st.sampled_from([1e3, -1e7, 1e12]))
    return points, draw(st.sampled_from([1e-3, 0.07, 0.3, 1.0, 5.0])), random


@relaxed
@given(clouds())
def test_voxels_equal_the_reference(cloud):
    points, size, _ = cloud
    found = downsample(points, voxel_size=size, device="cpu")
    centroids, nearest = voxel_means(points, size)
    # A rounding of the coordinates, and one of each addition relative to the voxel's first point.
    np.testing.assert_allclose(found.points, centroids, rtol=3e-16, atol=size * len(points) * 2.0**-53)
    d = points[found.indices] - centroids
    wanted = points[nearest] - centroids
    np.testing.assert_allclose(
        np.linalg.norm(d, axis=1), np.linalg.norm(wanted, axis=1), rtol=1e-9, atol=np.abs(points).max() * 1e-15
    )


@relaxed
@given(clouds())
def test_farthest_points_equal_the_reference(cloud):
    points, _, random = cloud
    start = int(random.integers(len(points)))
    count = int(random.integers(1, len(points) + 1))
    found = downsample(points, count=count, start=start, device="cpu")
    np.testing.assert_array_equal(found.indices, farthest_point_order(points, count, start))
    np.testing.assert_array_equal(found.points, points[found.indices])


@relaxed
@given(clouds(), st.integers(0, 3))
def test_poisson_disk_subset_equals_the_reference_and_is_one(cloud, seed):
    points, radius, _ = cloud
    found = downsample(points, radius=radius, seed=seed, device="cpu")
    np.testing.assert_array_equal(found.indices, poisson_disk_indices(points, radius, seed))
    tree = cKDTree(found.points)
    # No two kept points nearer than the radius; every other point nearer than the radius to a kept one.
    if len(found.points) > 1:
        assert tree.query(found.points, k=2)[0][:, 1].min() >= radius * (1.0 - 1e-15)
    assert tree.query(points)[0].max() < radius


@pytest.mark.slow
@relaxed
@given(clouds(), st.sampled_from([2.0**-30, 2.0**30]))
def test_scale_that_rounds_nothing(cloud, scale):
    points, size, random = cloud
    count = int(random.integers(1, len(points) + 1))
    for choice in ({"voxel_size": size}, {"count": count}, {"radius": size}):
        changed = {name: value if name == "count" else value * scale for name, value in choice.items()}
        base, other = downsample(points, **choice, device="cpu"), downsample(points * scale, **changed, device="cpu")
        np.testing.assert_array_equal(other.indices, base.indices)
        np.testing.assert_array_equal(other.points, base.points * scale)


@relaxed
@given(clouds(), st.permutations(range(3)))
def test_swapped_axes_swap_the_voxels(cloud, axes):
    points, size, _ = cloud
    base = downsample(points, voxel_size=size, device="cpu").points[:, axes]
    other = downsample(points[:, axes], voxel_size=size, device="cpu").points
    cells = np.floor(points / size)[:, axes]
    assert len(other) == len(np.unique(cells, axis=0))
    np.testing.assert_array_equal(np.unique(other, axis=0), np.unique(base, axis=0))


@relaxed
@given(clouds())
def test_order_of_the_points(cloud):
    points, size, random = cloud
    shuffle = random.permutation(len(points))
    base = downsample(points, voxel_size=size, device="cpu").points
    other = downsample(points[shuffle], voxel_size=size, device="cpu").points
    np.testing.assert_allclose(other, base, rtol=3e-16, atol=2.0 * size * len(points) * 2.0**-53)


@relaxed
@given(clouds())
def test_farthest_points_are_ever_nearer_and_cover(cloud):
    points, _, random = cloud
    count = int(random.integers(1, len(points) + 1))
    taken = downsample(points, count=count, device="cpu").points
    # The distance at which each was taken, and that of the farthest point left.
    away = [np.linalg.norm(taken[:k] - taken[k], axis=1).min() for k in range(1, count)]
    away.append(cKDTree(taken).query(points)[0].max())
    assert all(a >= b * (1.0 - 1e-12) for a, b in itertools.pairwise(away))


@pytest.mark.parametrize("choice", [{"voxel_size": 0.05}, {"count": 700}, {"radius": 0.04}])
def test_threads_change_nothing(choice, monkeypatch):
    monkeypatch.setattr(voxel_centroids, "COUNTED_SHARE", 3000)
    points = np.random.default_rng(0).random((20_000, 3))
    found = []
    for threads in ("1", "2", "3"):
        with mock.patch.dict(os.environ, {"GEOKIT_THREADS": threads}):
            found.append(downsample(points, **choice, device="cpu"))
    for other in found[1:]:
        np.testing.assert_array_equal(other.points, found[0].points)
        np.testing.assert_array_equal(other.indices, found[0].indices)


@pytest.mark.parametrize("choice", [{"voxel_size": 0.05}, {"count": 50}, {"radius": 0.04}])
def test_inputs_are_not_changed(choice):
    points = np.random.default_rng(0).random((5000, 3))
    before = points.copy()
    downsample(points, **choice, device="cpu")
    np.testing.assert_array_equal(points, before)
