"""What holds for orders 2 and 3, for any field under any affine transform."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.catalog.float_grids import build_float_grid
from geokit.volume._curvature import hessian
from geokit.volume.at_points.sample import gradient, sample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of

EXAMPLES = settings(max_examples=25, deadline=None)
seeds = st.integers(0, 2**32 - 1)
orders = st.sampled_from([2, 3])
origins = st.tuples(*[st.integers(-60, 60)] * 3).map(lambda o: np.array(o) * 8)


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
    """Float grid of 24 x 16 x 16 voxels from ``lower`` on; ``field`` takes voxels (N, 3), counted from ``lower``."""
    blocks = np.array(list(np.ndindex(3, 2, 2))) * 8
    leaves = np.stack([field(block + np.array(list(np.ndindex(8, 8, 8)))) for block in blocks]).astype(np.float32)
    buffer = build_float_grid(
        (blocks + lower).astype(np.int32),
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
    return lambda ijk: table[tuple(ijk.T)]


def _to_world(transform, u):
    return u @ transform[:3, :3].T + transform[:3, 3]


@pytest.mark.slow
@EXAMPLES
@given(seeds, orders, origins)
def test_quadratic_fields_are_exact_with_all_their_derivatives(seed, order, lower):
    rng = np.random.default_rng(seed)
    # Whole numbers below 2^24 are exact in float32: the field in the grid is quadratic to the last bit.
    matrix = rng.integers(-20, 21, (3, 3))
    matrix = matrix + matrix.T
    slope, constant = rng.integers(-50, 51, 3), int(rng.integers(-50, 51))

    def field(p):
        return ((p @ matrix) * p).sum(axis=1) + p @ slope + constant

    transform = _transform(seed)
    volume = _volume(field, lower, transform)
    local = rng.uniform(1.0, [21.999, 13.999, 13.999], (150, 3))
    points = _to_world(transform, local + lower)
    # The points' rounding, 500 voxels times a condition number of 30 times 1e-16, times a slope of at most 6000.
    np.testing.assert_allclose(sample(volume, points, order=order, device="cpu"), field(local), rtol=0, atol=1e-7)
    inverse = np.linalg.inv(transform[:3, :3])
    found = gradient(volume, points, order=order, device="cpu")
    np.testing.assert_allclose(found, (2 * local @ matrix + slope) @ inverse, rtol=0, atol=1e-7)
    second = hessian(volume, points, order=order, device="cpu")
    expected = np.broadcast_to(inverse.T @ (2 * matrix) @ inverse, second.shape)
    np.testing.assert_allclose(second, expected, rtol=0, atol=1e-6)


@EXAMPLES
@given(seeds)
def test_cubic_fields_are_not_reproduced_but_their_slopes_half_way_are(seed):
    rng = np.random.default_rng(seed)
    a, b, c = (int(n) for n in rng.integers(1, 5, 3))
    volume = _volume(lambda p: a * p[:, 0] ** 3 + b * p[:, 1] ** 3 + c * p[:, 2] ** 3, np.zeros(3, int), np.eye(4))
    u = rng.uniform(1.0, [21.999, 13.999, 13.999], (150, 3))
    t = u - np.floor(u)
    # With Catmull-Rom slopes x^3 is off by t (1 - t) (1 - 2 t): of third order in the voxel size, 0 at t = 1/2.
    error = sample(volume, u, order=3, device="cpu") - u**3 @ [a, b, c]
    np.testing.assert_allclose(error, (t * (1 - t) * (1 - 2 * t)) @ [a, b, c], rtol=0, atol=1e-8)
    # The parabola is off by t (1 - t) (1 + t).
    error = sample(volume, u, order=2, device="cpu") - u**3 @ [a, b, c]
    np.testing.assert_allclose(error, -(t * (t - 1) * (t + 1)) @ [a, b, c], rtol=0, atol=1e-8)


@pytest.mark.slow
@EXAMPLES
@given(seeds, orders, origins)
def test_place_in_index_space_does_not_change_the_values(seed, order, lower):
    field, transform = _random_field(seed), _transform(seed)
    plain = _volume(field, np.zeros(3, int), np.eye(4))
    moved = _volume(field, lower, transform)
    u = np.random.default_rng(seed).uniform(-3.0, [26, 18, 18], (300, 3))
    points = _to_world(transform, u + lower)
    expected = sample(plain, u, order=order, device="cpu")
    np.testing.assert_allclose(sample(moved, points, order=order, device="cpu"), expected, rtol=0, atol=1e-8)
    inverse = np.linalg.inv(transform[:3, :3])
    # A point within rounding of a cell's border may be on its other side.
    clear = (np.abs(u - np.round(u)) > 1e-6).all(axis=1)
    found = gradient(moved, points, order=order, device="cpu")
    np.testing.assert_allclose(
        found[clear], (gradient(plain, u, order=order, device="cpu") @ inverse)[clear], rtol=0, atol=1e-6
    )


@pytest.mark.slow
@EXAMPLES
@given(seeds, orders)
def test_gradient_is_the_derivative_of_the_sample(seed, order):
    rng = np.random.default_rng(seed)
    transform = _transform(seed)
    volume = _volume(_random_field(seed), np.zeros(3, int), transform)
    u = np.floor(rng.uniform(1, [21, 13, 13], (100, 3))) + rng.uniform(0.3, 0.7, (100, 3))
    along = gradient(volume, _to_world(transform, u), order=order, device="cpu") @ transform[:3, :3]
    for axis in range(3):
        step = np.eye(3)[axis] * 0.1
        # Inside a cell the interpolant is a cubic along each axis: four samples give its derivative exactly.
        f = [sample(volume, _to_world(transform, u + s * step), order=order, device="cpu") for s in (-2, -1, 1, 2)]
        np.testing.assert_allclose(along[:, axis], (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / 1.2, rtol=0, atol=1e-9)


@pytest.mark.slow
@EXAMPLES
@given(seeds, orders)
def test_order_of_the_points_and_their_company_do_not_matter(seed, order):
    rng = np.random.default_rng(seed)
    volume = _volume(_random_field(seed), np.zeros(3, int), _transform(seed), background=9.0)
    points = _to_world(volume.info.transform, rng.uniform(-2, 26, (1500, 3)))
    kept, shuffle = points.copy(), rng.permutation(1500)
    for function in (sample, gradient, hessian):
        whole = function(volume, points, order=order, device="cpu")
        np.testing.assert_array_equal(function(volume, points[shuffle], order=order, device="cpu"), whole[shuffle])
        np.testing.assert_array_equal(function(volume, points[17:18], order=order, device="cpu"), whole[17:18])
    np.testing.assert_array_equal(points, kept)


@pytest.mark.slow
@EXAMPLES
@given(seeds, orders)
def test_samples_overshoot_by_a_bounded_share(seed, order):
    rng = np.random.default_rng(seed)
    field = _random_field(seed)
    volume = _volume(field, np.zeros(3, int), np.eye(4))
    u = rng.uniform(1, [21.999, 13.999, 13.999], (300, 3))
    around = np.floor(u).astype(int)[:, None] - 1 + np.array(list(np.ndindex(*3 * [order + 1])))
    values = field(around.reshape(-1, 3)).reshape(len(u), -1).astype(float)
    low, high = values.min(axis=1), values.max(axis=1)
    # The negative weights of an axis add up to 1/8 at most, so that the weights' absolute sum is at most (5/4)^3.
    reach = ((5 / 4) ** 3 - 1) / 2 * (high - low) + 1e-12
    found = sample(volume, u, order=order, device="cpu")
    assert (found >= low - reach).all()
    assert (found <= high + reach).all()
