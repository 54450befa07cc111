"""Sampling far away: from the origin of index space, from the world's origin, at tiny and huge scales, off the grid."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.volume._build import build_float_grid
from geokit.volume._nanovdb import info_of
from geokit.volume.model import SparseVolume
from geokit.volume.sample import gradient, sample

# Fractions with 20 bits: together with coordinates below 2^31 they are exact in float64.
FRACTION_STEP = 2.0**-20
EPSILON = 2.0**-53


def _grid(lower, transform):
    """A random field on 16^3 voxels from ``lower`` on, always the same one."""
    dense = np.random.default_rng(0).normal(size=(16, 16, 16)).astype(np.float32)
    leaves = dense.reshape(2, 8, 2, 8, 2, 8).transpose(0, 2, 4, 1, 3, 5).reshape(8, 512)
    origins = np.array(list(np.ndindex(2, 2, 2))) * 8 + lower
    buffer = build_float_grid(
        origins.astype(np.int32),
        leaves,
        np.ones((8, 512), bool),
        background=2.5,
        transform=transform,
        name="field",
        grid_class="unknown",
        signed_fill=False,
    )
    return SparseVolume(buffer, info_of(buffer))


def _scaled(voxel_size, translation):
    transform = np.diag([voxel_size] * 3 + [1.0])
    transform[:3, 3] = translation
    return transform


@pytest.fixture(scope="module")
def local():
    return np.random.default_rng(1).integers(-(2**20), 17 * 2**20, (2000, 3)) * FRACTION_STEP


@pytest.fixture(scope="module")
def reference(local):
    volume = _grid(np.zeros(3, int), np.eye(4))
    return [f(volume, local, order=order, device="cpu") for f in (sample, gradient) for order in (0, 1)]


# -1000000 and 1000000 are multiples of 8, the last two reach the ends of int32.
@pytest.mark.parametrize("lower", [-1_000_000, 1_000_000, 2**31 - 4096, -(2**31) + 4096])
def test_any_place_in_index_space_gives_the_same_bits(lower, local, reference):
    volume = _grid(np.full(3, lower), np.eye(4))
    found = [f(volume, local + lower, order=order, device="cpu") for f in (sample, gradient) for order in (0, 1)]
    for value, expected in zip(found, reference, strict=True):
        np.testing.assert_array_equal(value, expected)


@pytest.mark.parametrize("voxels", [1e6, -1e6, 2.0**40])
def test_translation_of_a_million_voxels_gives_the_same_bits(voxels, local):
    # Voxels of 2^-3 and 12 bits of fraction: points stay exact up to 2^40 voxels away.
    coarse = np.floor(local * 2**12) / 2**12
    near, far = _grid(np.zeros(3, int), _scaled(0.125, 0.0)), _grid(np.zeros(3, int), _scaled(0.125, voxels * 0.125))
    for function in (sample, gradient):
        for order in (0, 1):
            expected = function(near, coarse * 0.125, order=order, device="cpu")
            found = function(far, coarse * 0.125 + voxels * 0.125, order=order, device="cpu")
            np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("distance", 10.0 ** np.arange(0, 13, 2))
def test_error_grows_with_the_rounding_of_the_points_only(distance, local, reference):
    translation = distance * np.array([0.6, -0.5, 0.62])
    volume = _grid(np.zeros(3, int), _scaled(0.1, translation))
    error = np.abs(sample(volume, local * 0.1 + translation, device="cpu") - reference[1])
    # Index coordinates are off by the rounding of the point, of the translation and of 0.1; a voxel differs from its
    # neighbour by less than 8 (normal deviates), and three axes add up.
    offset = 3 * 3 * EPSILON * (distance + 2.0) / 0.1
    assert error.max() <= 8 * offset


@pytest.mark.parametrize("voxel_size", [1e-100, 1e-12, 1e-6, 1e6, 1e12, 1e100])
def test_any_voxel_size(voxel_size, local, reference):
    volume = _grid(np.zeros(3, int), _scaled(voxel_size, 0.0))
    assert np.abs(sample(volume, local * voxel_size, device="cpu") - reference[1]).max() < 1e-12
    slope = gradient(volume, local * voxel_size, device="cpu") * voxel_size
    # On a cell's border the rounding of the point decides on which side it is.
    off_border = (np.abs(local - np.round(local)) > 1e-9).all(axis=1)
    assert off_border.mean() > 0.9
    assert np.abs(slope - reference[3])[off_border].max() < 1e-11


@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_needle_voxels_and_shear(ratio, local, reference):
    transform = np.eye(4)
    transform[:3, :3] = [[1.0, ratio, 0.0], [0.0, 1.0, 0.0], [0.3, 0.0, ratio]]
    volume = _grid(np.zeros(3, int), transform)
    points = local @ transform[:3, :3].T
    # The condition number of the transform, about ratio^2, times the rounding of the points.
    offset = 16 * EPSILON * ratio**2 * 17
    error = np.abs(sample(volume, points, device="cpu") - reference[1])
    assert error.max() <= 8 * 3 * offset


@pytest.mark.parametrize("scale", [2.0**31, 1e10, 1e20, 1e300, 1e305])
@pytest.mark.parametrize("order", [0, 1])
def test_beyond_every_voxel_is_background_with_no_slope(scale, order):
    rng = np.random.default_rng(4)
    directions = rng.choice([-1.0, 0.0, 1.0], (200, 3))
    points = directions[np.abs(directions).any(axis=1)] * scale
    for transform in (np.eye(4), np.array([[1, -1, 1, 5], [0, 1e-3, -1, 5], [0, 0, 1e-3, 5], [0, 0, 0, 1.0]])):
        volume = _grid(np.zeros(3, int), transform)
        assert (sample(volume, points, order=order, device="cpu") == 2.5).all()
        assert not gradient(volume, points, order=order, device="cpu").any()
