"""Balls towards the ends of what can be: voxel sizes, distance from the origin, scattered clusters, one-voxel balls."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.errors import InputError
from geokit.volume._from_points import from_points
from geokit.volume.nanovdb.checks import check_grid
from tests.support.reference import union_of_balls

ROUNDING = 6.0e-8


def errors(points, radii, voxel_size, half_width=3.0, seed=0) -> float:
    """Largest error of values near the surfaces [voxels]."""
    volume = from_points(points, radii, voxel_size=voxel_size, half_width=half_width, device="cpu")
    check_grid(volume.nanovdb, "points")
    rng = np.random.default_rng(seed)
    nearest = rng.integers(0, len(points), 2000)
    direction = rng.standard_normal((2000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    transform = volume.info.transform
    around = points[nearest] + direction * np.broadcast_to(radii, len(points))[nearest, None]
    index = np.round((around - transform[:3, 3]) / voxel_size)
    world = index * voxel_size + transform[:3, 3]
    band = half_width * voxel_size
    exact = np.clip(union_of_balls(world, points, radii), -band, band)
    return float(np.abs(volume.sample(world, order=0, device="cpu") - exact).max() / voxel_size)


@pytest.mark.parametrize("voxel_size", [1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_every_scale(voxel_size):
    points = voxel_size * np.random.default_rng(0).uniform(-20, 20, (20, 3))
    assert errors(points, 5.0 * voxel_size, voxel_size) < 3.0 * ROUNDING


@pytest.mark.parametrize("distance", [1e3, 1e6, 1e9, 1e12])
def test_far_from_the_origin(distance):
    # Beyond 2^20 voxels the transform moves. Coordinates of 1e12 have steps of 1.2e-4: that is what positions lose.
    points = distance + np.random.default_rng(1).uniform(-20, 20, (20, 3))
    assert errors(points, 5.0, 1.0) < 3.0 * ROUNDING + 8 * np.spacing(distance)


def test_scattered_clusters():
    # 2^21 tiles along an axis is the limit: a little less works, and takes no more than the clusters do.
    points = np.array([[0.0, 0.0, 0.0], [1.6e7, 0.0, 0.0], [0.0, 1.6e7, -1.0e6]])
    volume = from_points(points, 4.0, voxel_size=1.0, device="cpu")
    assert len(volume.nanovdb) < 3 << 20
    assert errors(points, 4.0, 1.0) < 3.0 * ROUNDING + 8 * np.spacing(1.6e7)
    with pytest.raises(InputError, match="tiles of 8 voxels"):
        from_points(2.0 * points, 4.0, voxel_size=1.0, device="cpu")


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.1, 0.5, 0.87, 1.0, 8.0, 8.0 - 3.0, 13.0, 29.0, 61.0])
def test_radii_around_the_sizes_of_buckets(radius):
    points = np.random.default_rng(2).uniform(-30, 30, (6, 3))
    for r in (radius, np.nextafter(radius, 0), np.nextafter(radius, 100)):
        assert errors(points, r, 1.0) < 3.0 * ROUNDING


@pytest.mark.parametrize("offset", [0.0, 0.5, -0.5, 8.0, -8.0, 7.5, 4096.0, -4096.0])
def test_centers_on_the_borders_of_voxels_leaves_and_nodes(offset):
    assert errors(np.full((1, 3), offset), 4.0, 1.0) < 3.0 * ROUNDING


@pytest.mark.slow
def test_ten_thousand_balls_in_one_place():
    # Every tile lists every ball: no list grows beyond its share of the memory.
    points = np.random.default_rng(3).normal(0, 1e-3, (10_000, 3))
    assert errors(points, 3.0, 1.0) < 3.0 * ROUNDING
