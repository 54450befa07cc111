"""Clusters by density on hand-sized inputs: numbers, borders, ties, containers and every error."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit.points._cluster import cluster


def line(*x):
    return np.stack([np.array(x, dtype=float), np.zeros(len(x)), np.zeros(len(x))], axis=1)


def labels_of(points, **settings):
    return cluster(points, device="cpu", **settings).tolist()


def test_two_clusters_and_noise():
    points = line(10.0, 0.0, 1.0, 2.0, 11.0, 12.0, 50.0)
    # 10 and 12 have two points within 1, 11 has three: with 3 the ends are borders.
    assert labels_of(points, radius=1.0, minimum_count=3) == [1, 0, 0, 0, 1, 1, -1]


def test_clusters_are_numbered_by_their_lowest_core_point():
    # The lowest index of the left cluster, 0, is a border point; its core points are 3 and 4, the right one's 1, 2.
    points = line(0.0, 21.0, 22.0, 1.0, 2.0, 20.0, 23.0, 3.0)
    assert labels_of(points, radius=1.0, minimum_count=3) == [1, 0, 0, 1, 1, 0, 0, 1]


def test_border_point_goes_to_its_nearest_core_point():
    # Each side has one core point, -1 and 1, with 3 others within 1; the border point has only these two.
    points = line(-1.0, -1.5, -1.6, 0.0, 1.0, 1.5, 1.6)
    for x, wanted in ((-1e-9, 0), (1e-9, 1)):
        points[3, 0] = x
        # A step more than 1, so that both are within it.
        assert labels_of(points, radius=1.0 + 1e-8, minimum_count=4) == [0, 0, 0, wanted, 1, 1, 1]


@pytest.mark.parametrize("turned", [False, True])
def test_border_point_between_two_goes_to_the_lowest_index(turned):
    # 0.0 is 1.0 from the core points at -1 and 1, which are 2 apart.
    points = line(-1.0, -1.5, -1.6, 0.0, 1.0, 1.5, 1.6)
    if turned:
        points = -points
    assert labels_of(points, radius=1.0, minimum_count=4) == [0, 0, 0, 0, 1, 1, 1]


def test_a_chain_of_borders_is_not_followed():
    # The core point 1 has 0, 0.9 and 2 within 1; 3 has the border point 2 only.
    assert labels_of(line(0.0, 0.9, 1.0, 2.0, 3.0), radius=1.0, minimum_count=4) == [0, 0, 0, 0, -1]


def test_minimum_count_counts_the_point_itself():
    points = line(0.0, 1.0, 5.0)
    assert labels_of(points, radius=1.0, minimum_count=1) == [0, 0, 1]
    assert labels_of(points, radius=1.0, minimum_count=2) == [0, 0, -1]
    assert labels_of(points, radius=1.0, minimum_count=3) == [-1, -1, -1]
    assert labels_of(points, radius=1.0, minimum_count=10**12) == [-1, -1, -1]


def test_the_ball_is_closed():
    points = line(0.0, 0.1, 0.1 + 0.2)
    gap = float(points[2, 0] - points[1, 0])
    assert labels_of(points, radius=gap, minimum_count=1) == [0, 0, 0]
    assert labels_of(points, radius=float(np.nextafter(gap, 0.0)), minimum_count=1) == [0, 0, 1]


def test_radius_zero_joins_duplicates():
    points = np.array([[1.0, 2, 3], [1, 2, 3], [4, 5, 6], [1, 2, 3]])
    assert labels_of(points, radius=0.0, minimum_count=2) == [0, 0, -1, 0]


@pytest.mark.parametrize("count", [1, 64, 1000])
def test_identical_points(count):
    points = np.full((count, 3), 0.3)
    assert labels_of(points, radius=0.1, minimum_count=count) == [0] * count
    assert labels_of(points, radius=0.1, minimum_count=count + 1) == [-1] * count


def test_no_points():
    found = cluster(np.zeros((0, 3)), radius=1.0, device="cpu")
    assert (found.shape, found.dtype) == ((0,), np.int32)


def test_containers():
    points = line(0.0, 1.0, 5.0)
    assert cluster(points, radius=1.0, device="cpu").dtype == np.int32
    assert cluster(points.astype(np.float32).tolist(), radius=1.0, device="cpu").dtype == np.int32
    found = cluster(wp.array(points, dtype=wp.vec3d, device="cpu"), radius=1.0, minimum_count=1, device="cpu")
    assert isinstance(found, wp.array)
    assert found.numpy().tolist() == [0, 0, 1]


def test_input_is_left_alone():
    points = np.random.default_rng(0).random((100, 3))
    kept = points.copy()
    cluster(points, radius=0.2, device="cpu")
    np.testing.assert_array_equal(points, kept)


@pytest.mark.parametrize("radius", [-1.0, np.nan, np.inf, "wide"])
def test_radius_must_be_finite_and_not_negative(radius):
    with pytest.raises(gk.InputError, match="radius"):
        cluster(line(0.0), radius=radius, device="cpu")


@pytest.mark.parametrize("minimum_count", [0, -3, 2.5, True, "few"])
def test_minimum_count_must_be_a_whole_number(minimum_count):
    with pytest.raises(gk.InputError, match="minimum_count"):
        cluster(line(0.0), radius=1.0, minimum_count=minimum_count, device="cpu")


def test_points_and_device_are_checked():
    with pytest.raises(gk.InputError, match="points: row 1"):
        cluster(line(0.0, np.nan), radius=1.0, device="cpu")
    with pytest.raises(gk.InputError, match=r"points: shape \(2, 2\)"):
        cluster(np.zeros((2, 2)), radius=1.0, device="cpu")
    with pytest.raises(gk.InputError, match="device"):
        cluster(line(0.0), radius=1.0, device="abacus")
