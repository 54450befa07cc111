"""Sampling far away: from the origin of index space, from the world's origin, at tiny and huge scales, off the grid."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog.float_grids import build_float_grid
from geokit.volume.at_points.sample import gradient, sample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of

# Fractions with 20 bits: together with coordinates below 2^31 they are exact in float64.
FRACTION_STEP = 2.0**-20
EPSILON = 2.0**-53
ORDERS = (0, 1, 2, 3)
FUNCTIONS = (sample, gradient)


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
    return {(f, order): f(volume, local, order=order, device="cpu") for f in FUNCTIONS for order in ORDERS}


# -1000000 and 1000000 are multiples of 8, the last two reach the ends of int32.
@pytest.mark.parametrize("lower", [-1_000_000, 1_000_000, 2**30, -(2**30), 2**31 - 4096, -(2**31) + 4096])
def test_any_place_in_index_space_gives_the_same_bits(lower, local, reference):
    volume = _grid(np.full(3, lower), np.eye(4))
    for (function, order), expected in reference.items():
        np.testing.assert_array_equal(function(volume, local + lower, order=order, device="cpu"), expected)


@pytest.mark.parametrize("voxels", [1e6, -1e6, 2.0**30, 2.0**40])
def test_translation_of_a_million_voxels_gives_the_same_bits(voxels, local):
    # Voxels of 2^-3 and 12 bits of fraction: points stay exact up to 2^40 voxels away.
    coarse = np.floor(local * 2**12) / 2**12
    near, far = _grid(np.zeros(3, int), _scaled(0.125, 0.0)), _grid(np.zeros(3, int), _scaled(0.125, voxels * 0.125))
    for function in FUNCTIONS:
        for order in ORDERS:
            expected = function(near, coarse * 0.125, order=order, device="cpu")
            found = function(far, coarse * 0.125 + voxels * 0.125, order=order, device="cpu")
            np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("distance", 10.0 ** np.arange(0, 13, 2))
def test_error_grows_with_the_rounding_of_the_points_only(distance, order, local, reference):
    translation = distance * np.array([0.6, -0.5, 0.62])
    volume = _grid(np.zeros(3, int), _scaled(0.1, translation))
    error = np.abs(sample(volume, local * 0.1 + translation, order=order, device="cpu") - reference[sample, order])
    # Index coordinates are off by the rounding of the point, of the translation and of 0.1; a voxel differs from its
    # neighbor by less than 8 (normal deviates), and three axes add up. Slopes of orders 2 and 3 are up to three times
    # the differences of neighbors.
    offset = 3 * 3 * EPSILON * (distance + 2.0) / 0.1
    assert error.max() <= 8 * offset * (1 if order == 1 else 3)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("voxel_size", [1e-100, 1e-12, 1e-6, 1e6, 1e12, 1e100])
def test_any_voxel_size(voxel_size, order, local, reference):
    volume = _grid(np.zeros(3, int), _scaled(voxel_size, 0.0))
    points = local * voxel_size
    assert np.abs(sample(volume, points, order=order, device="cpu") - reference[sample, order]).max() < 1e-12
    slope = gradient(volume, points, order=order, device="cpu") * voxel_size
    # On a cell's border the rounding of the point decides on which side it is.
    off_border = (np.abs(local - np.round(local)) > 1e-9).all(axis=1)
    assert off_border.mean() > 0.9
    assert np.abs(slope - reference[gradient, order])[off_border].max() < 1e-11


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_needle_voxels_and_shear(ratio, order, local, reference):
    transform = np.eye(4)
    transform[:3, :3] = [[1.0, ratio, 0.0], [0.0, 1.0, 0.0], [0.3, 0.0, ratio]]
    volume = _grid(np.zeros(3, int), transform)
    points = local @ transform[:3, :3].T
    # The condition number of the transform, about ratio^2, times the rounding of the points.
    offset = 16 * EPSILON * ratio**2 * 17
    error = np.abs(sample(volume, points, order=order, device="cpu") - reference[sample, order])
    assert error.max() <= 8 * 3 * offset * (1 if order == 1 else 3)


@pytest.mark.parametrize("scale", [2.0**31, 1e10, 1e20, 1e300, 1e305])
@pytest.mark.parametrize("order", ORDERS)
def test_beyond_every_voxel_is_background_with_no_slope(scale, order):
    rng = np.random.default_rng(4)
    directions = rng.choice([-1.0, 0.0, 1.0], (200, 3))
    points = directions[np.abs(directions).any(axis=1)] * scale
    for transform in (np.eye(4), np.array([[1, -1, 1, 5], [0, 1e-3, -1, 5], [0, 0, 1e-3, 5], [0, 0, 0, 1.0]])):
        volume = _grid(np.zeros(3, int), transform)
        assert (sample(volume, points, order=order, device="cpu") == 2.5).all()
        assert not gradient(volume, points, order=order, device="cpu").any()


@pytest.mark.parametrize("order", ORDERS)
def test_the_last_voxels_of_int32(order):
    # A leaf at either end: its outermost voxels are within two of the end of int32, where the background takes over.
    for lower, last in ((2**31 - 8, 2**31 - 3), (-(2**31), -(2**31) + 1)):
        buffer = build_float_grid(
            np.full((1, 3), lower, np.int32),
            np.random.default_rng(0).normal(size=(1, 512)).astype(np.float32),
            np.ones((1, 512), bool),
            background=2.5,
            transform=np.eye(4),
            name="corner",
            grid_class="unknown",
            signed_fill=False,
        )
        volume = SparseVolume(buffer, info_of(buffer))
        at = np.full(3, float(last))
        value = np.random.default_rng(0).normal(size=(8, 8, 8)).astype(np.float32)[(last - lower,) * 3]
        assert sample(volume, [at], order=order, device="cpu") == [value]
        assert np.isfinite(gradient(volume, [at], order=order, device="cpu")).all()
        outward = np.sign(last)
        for beyond in (1.0, 2.0, 3.0, 1e6):
            assert sample(volume, [at + outward * beyond], order=order, device="cpu") == [2.5]
            assert not gradient(volume, [at + outward * beyond], order=order, device="cpu").any()
