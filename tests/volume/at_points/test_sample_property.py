"""What holds for sampling of any field under any affine transform."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.catalog.float_grids import build_float_grid
from geokit.volume.at_points.sample import gradient, sample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of

EXAMPLES = settings(max_examples=30, deadline=None)
seeds = st.integers(0, 2**32 - 1)
origins = st.tuples(*[st.integers(-600, 600)] * 3).map(lambda o: np.array(o) * 8)


def _transform(seed: int) -> np.ndarray:
    """A random rotation, shear and scale with a condition number below 30, and a translation."""
    rng = np.random.default_rng(seed)
    u, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    v, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    transform = np.eye(4)
    transform[:3, :3] = u @ np.diag(rng.uniform(0.1, 3.0, 3)) @ v
    transform[:3, 3] = rng.uniform(-100, 100, 3)
    return transform


def _volume(field, lower, transform, background=0.0):
    """Float grid of 24 x 16 x 16 voxels from ``lower`` on; ``field`` gives the values of voxels (N, 3)."""
    blocks = np.array(list(np.ndindex(3, 2, 2))) * 8 + lower
    voxels = np.array(list(np.ndindex(8, 8, 8)))
    leaves = np.stack([field(block + voxels) for block in blocks]).astype(np.float32)
    buffer = build_float_grid(
        blocks.astype(np.int32),
        leaves,
        np.ones(leaves.shape, bool),
        background=background,
        transform=transform,
        name="field",
        grid_class="unknown",
        signed_fill=False,
    )
    return SparseVolume(buffer, info_of(buffer))


def _random_field(seed):
    table = np.random.default_rng(seed).normal(size=(24, 16, 16)).astype(np.float32)
    return lambda ijk, lower: table[tuple((ijk - lower).T)]


def _to_world(transform, u):
    return u @ transform[:3, :3].T + transform[:3, 3]


@EXAMPLES
@given(seeds, origins, st.tuples(*[st.integers(-50, 50)] * 4))
def test_linear_fields_and_their_gradients_are_exact(seed, lower, coefficients):
    # Whole numbers below 2^24 are exact in float32: the field in the grid is linear to the last bit.
    slope, constant = np.array(coefficients[:3]), coefficients[3]
    transform = _transform(seed)
    volume = _volume(lambda ijk: ijk @ slope + constant, lower, transform)
    u = lower + np.random.default_rng(seed).uniform(0.0, [22.999, 14.999, 14.999], (200, 3))
    points = _to_world(transform, u)
    # Coordinates below 6000 voxels of up to 3, and a condition number of 30.
    scale = 6000 * 3 * 30 * max(1, np.abs(slope).sum())
    np.testing.assert_allclose(sample(volume, points, device="cpu"), u @ slope + constant, rtol=0, atol=4e-16 * scale)
    world_slope = np.linalg.solve(transform[:3, :3].T, slope.astype(float))
    found = gradient(volume, points, device="cpu")
    np.testing.assert_allclose(found, np.broadcast_to(world_slope, found.shape), rtol=0, atol=1e-10)
    inner = _to_world(transform, lower + np.random.default_rng(seed).uniform(1.0, [21, 13, 13], (200, 3)))
    found = gradient(volume, inner, order=0, device="cpu")
    np.testing.assert_allclose(found, np.broadcast_to(world_slope, found.shape), rtol=0, atol=1e-10)


@pytest.mark.slow
@EXAMPLES
@given(seeds, origins)
def test_orders_agree_at_voxel_centers(seed, lower):
    field = _random_field(seed)
    volume = _volume(lambda ijk: field(ijk, lower), lower, np.eye(4))
    centers = lower + np.array(list(np.ndindex(24, 16, 16)))[::7]
    expected = field(centers, lower)
    for order in (0, 1):
        np.testing.assert_array_equal(sample(volume, centers, order=order, device="cpu"), expected)


@pytest.mark.slow
@EXAMPLES
@given(seeds, origins)
def test_transform_does_not_change_the_values(seed, lower):
    field, transform = _random_field(seed), _transform(seed)
    plain = _volume(lambda ijk: field(ijk, lower), lower, np.eye(4))
    moved = _volume(lambda ijk: field(ijk, lower), lower, transform)
    u = lower + np.random.default_rng(seed).uniform(-3.0, [26, 18, 18], (300, 3))
    points = _to_world(transform, u)
    # Neighbors differ by less than 10; coordinates and condition as above.
    np.testing.assert_allclose(sample(moved, points, device="cpu"), sample(plain, u, device="cpu"), rtol=0, atol=1e-8)
    index_gradient = np.linalg.solve(transform[:3, :3].T, gradient(plain, u, device="cpu").T).T
    # A point within rounding of a cell's border may be on its other side.
    clear = (np.abs(u - np.round(u)) > 1e-6).all(axis=1)
    found = gradient(moved, points, device="cpu")
    np.testing.assert_allclose(found[clear], index_gradient[clear], rtol=0, atol=1e-6)


@EXAMPLES
@given(seeds, st.integers(0, 1))
def test_order_of_the_points_and_their_company_do_not_matter(seed, order):
    rng = np.random.default_rng(seed)
    field = _random_field(seed)
    volume = _volume(lambda ijk: field(ijk, 0), np.zeros(3, int), _transform(seed), background=9.0)
    points = _to_world(volume.info.transform, rng.uniform(-2, 26, (1500, 3)))
    kept = points.copy()
    whole, slopes = (f(volume, points, order=order, device="cpu") for f in (sample, gradient))
    shuffle = rng.permutation(len(points))
    np.testing.assert_array_equal(sample(volume, points[shuffle], order=order, device="cpu"), whole[shuffle])
    np.testing.assert_array_equal(gradient(volume, points[shuffle], order=order, device="cpu"), slopes[shuffle])
    np.testing.assert_array_equal(sample(volume, points[17:18], order=order, device="cpu"), whole[17:18])
    np.testing.assert_array_equal(points, kept)


@EXAMPLES
@given(seeds)
def test_gradient_is_the_derivative_of_the_sample(seed):
    rng = np.random.default_rng(seed)
    field = _random_field(seed)
    volume = _volume(lambda ijk: field(ijk, 0), np.zeros(3, int), _transform(seed))
    # Inside a cell the interpolant is linear along each index axis: differences over any step are exact.
    u = np.floor(rng.uniform(0, [23, 15, 15], (100, 3))) + rng.uniform(0.3, 0.7, (100, 3))
    slope = gradient(volume, _to_world(volume.info.transform, u), device="cpu")
    for axis in range(3):
        step = np.eye(3)[axis] * 0.25
        ends = [sample(volume, _to_world(volume.info.transform, u + s), device="cpu") for s in (step, -step)]
        along = slope @ volume.info.transform[:3, axis]
        np.testing.assert_allclose(along, (ends[0] - ends[1]) / 0.5, rtol=0, atol=1e-9)


@EXAMPLES
@given(seeds)
def test_samples_stay_between_the_voxels_around(seed):
    rng = np.random.default_rng(seed)
    field = _random_field(seed)
    volume = _volume(lambda ijk: field(ijk, 0), np.zeros(3, int), np.eye(4))
    u = rng.uniform(0, [22.999, 14.999, 14.999], (500, 3))
    corners = np.floor(u).astype(int)[:, None] + np.array(list(np.ndindex(2, 2, 2)))
    around = field(corners.reshape(-1, 3), 0).reshape(-1, 8).astype(float)
    found = sample(volume, u, device="cpu")
    # Rounding of values below 10.
    assert (found >= around.min(axis=1) - 1e-14).all()
    assert (found <= around.max(axis=1) + 1e-14).all()
