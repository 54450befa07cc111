"""Outliers by both definitions on hand-sized inputs, beside the definitions in NumPy, and every error."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial import cKDTree

import geokit as gk
from geokit.points._outliers import outliers

LINE = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [90, 0, 0]])


def by_open3d(points, nb_neighbors, std_ratio):
    """The points that Open3D's remove_statistical_outlier removes: a point is the first of its own nb_neighbors."""
    mean = cKDTree(points).query(points, nb_neighbors)[0].mean(axis=1)
    return mean >= mean.mean() + std_ratio * mean.std(ddof=1)


def cloud(seed, count=800):
    random = np.random.default_rng(seed)
    points = random.normal(size=(count, 3))
    points[:: count // 20] *= 4.0
    return points


@pytest.mark.parametrize("k", [1, 5, 16, 40])
@pytest.mark.parametrize("ratio", [-0.5, 0.0, 1.0, 2.0, 3.7])
def test_statistical_equals_open3d_s_definition(k, ratio):
    points = cloud(k)
    found = outliers(points, k=k, ratio=ratio, device="cpu")
    np.testing.assert_array_equal(found, by_open3d(points, k + 1, ratio))
    assert 0 < found.sum() < len(points)


@pytest.mark.parametrize("radius", [0.2, 0.5, 1.5])
@pytest.mark.parametrize("minimum_count", [1, 4, 30])
def test_radius_equals_the_definition(radius, minimum_count):
    points = cloud(0)
    others = cKDTree(points).query_ball_point(points, radius, return_length=True) - 1
    found = outliers(points, method="radius", radius=radius, minimum_count=minimum_count, device="cpu")
    np.testing.assert_array_equal(found, others < minimum_count)
    assert found.any()


def test_a_hand_made_set():
    assert outliers(LINE, k=1, ratio=1.0, device="cpu").tolist() == [False] * 4 + [True]
    assert outliers(LINE, method="radius", radius=1.0, minimum_count=2, device="cpu").tolist() == [
        True, False, False, True, True,
    ]  # fmt: skip


def test_fewer_points_than_neighbors():
    # All four others are taken: means 24, 23.5, 23.5, 24 and 88.5.
    assert outliers(LINE, k=100, ratio=1.0, device="cpu").tolist() == [False] * 4 + [True]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_points(count):
    for settings in ({}, {"method": "radius", "radius": 9.0, "minimum_count": 1}):
        found = outliers(LINE[:count], device="cpu", **settings)
        assert found.dtype == np.bool_
        assert found.tolist() == [count == 1 and "radius" in settings] * count


@pytest.mark.parametrize("size", [1e-150, 0.1, 1 / 3, 1e150])
def test_equal_distances_have_no_outliers(size):
    # The mean of equal numbers must not be a rounding below them.
    points = np.array([[0.0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]]) * size
    for ratio in (0.0, 1.0):
        assert not outliers(points, k=3, ratio=ratio, device="cpu").any()


def test_duplicates_are_no_outliers():
    points = np.concatenate([np.zeros((20, 3)), [[1.0, 0, 0]]])
    assert outliers(points, k=4, ratio=1.0, device="cpu").tolist() == [False] * 20 + [True]


@pytest.mark.parametrize(("offset", "scale"), [(0.0, 2.0**-20), (2.0**20, 1.0)])
def test_offset_and_scale_change_nothing(offset, scale):
    # Rounded to 2^-30 beforehand, the points move without a further rounding.
    points = np.round(cloud(3) * 2**30) / 2**30
    wanted = outliers(points, device="cpu")
    np.testing.assert_array_equal(outliers(points * scale + offset, device="cpu"), wanted)


def test_containers():
    points = cloud(1)
    wanted = outliers(points, device="cpu")
    assert wanted.dtype == np.bool_
    found = outliers(wp.array(points, dtype=wp.vec3d, device="cpu"), device="cpu")
    assert isinstance(found, wp.array)
    np.testing.assert_array_equal(found.numpy(), wanted)
    assert outliers(points.astype(np.float32), device="cpu").dtype == np.bool_


def test_input_is_left_alone():
    points = cloud(2)
    kept = points.copy()
    outliers(points, device="cpu")
    np.testing.assert_array_equal(points, kept)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("method", {"method": "visual"}),
        ("k", {"k": 0}),
        ("k", {"k": 1025}),
        ("k", {"k": 2.5}),
        ("ratio", {"ratio": np.nan}),
        ("ratio", {"ratio": np.inf}),
        ("ratio", {"ratio": "two"}),
        ("radius", {"radius": 1.0}),
        ("radius", {"method": "radius"}),
        ("radius", {"method": "radius", "radius": -1.0}),
        ("radius", {"method": "radius", "radius": np.nan}),
        ("minimum_count", {"method": "radius", "radius": 1.0, "minimum_count": 0}),
        ("minimum_count", {"method": "radius", "radius": 1.0, "minimum_count": 2.0}),
        ("device", {"device": "abacus"}),
    ],
)
def test_settings_are_checked(name, settings):
    with pytest.raises(gk.InputError, match=f"^{name}:"):
        outliers(LINE, **{"device": "cpu", **settings})


def test_points_are_checked():
    bad = LINE.copy()
    bad[3, 1] = np.inf
    with pytest.raises(gk.InputError, match="points: row 3"):
        outliers(bad, device="cpu")
    with pytest.raises(gk.InputError, match=r"points: shape \(5, 2\)"):
        outliers(LINE[:, :2], device="cpu")
