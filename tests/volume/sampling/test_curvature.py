"""Hessians and curvatures against analytic fields."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog.float_grids import build_float_grid
from benchmarks.catalog.sphere_volumes import VOXELS
from benchmarks.catalog.typed_grids import QUANTIZED, VALUED, TypedGrid
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume._curvature import Curvatures, curvature, hessian
from geokit.volume.at_points.sample import gradient
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of
from tests.support.effort import of_all
from tests.support.reference import tensor_interpolant

ORDERS = (2, 3)
SHEARED = np.array([[0.5, 0.2, 0.0, 3.0], [-0.1, 0.25, 0.3, -7.0], [0.0, 0.1, 2.0, 11.0], [0.0, 0.0, 0.0, 1.0]])
SCALARS = [kind for kind in VALUED if not kind.startswith(("vec", "rgba"))]
VECTORS = sorted(set(VALUED) - set(SCALARS))
# Quantized voxels are decoded in float32, with or without a fused multiply-add.
DECODING = 1e-6


def field_grid(field, half: int, transform: np.ndarray | None = None) -> SparseVolume:
    """A float grid of 2 ``half`` leaves along each axis around the origin; ``field`` takes index coordinates."""
    origins = (np.array(list(np.ndindex(*3 * [2 * half]))) - half) * 8
    values = field(origins[:, None] + VOXELS).astype(np.float32)
    buffer = build_float_grid(
        origins.astype(np.int32),
        values,
        np.ones(values.shape, bool),
        background=100.0,
        transform=np.eye(4) if transform is None else transform,
        name="field",
        grid_class="level set",
        signed_fill=False,
    )
    return SparseVolume(buffer, info_of(buffer))


def _directions(count=4000):
    d = np.random.default_rng(0).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.slow
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("grid_type", SCALARS)
def test_hessian_of_every_type_in_a_sheared_grid(grid_type, order):
    grid = TypedGrid(grid_type, SHEARED)
    u = np.random.default_rng(3).uniform([-11, -3, -3], [11, 11, 19], (of_all(30, 60), 3))
    found = hessian(grid.volume, u @ SHEARED[:3, :3].T + SHEARED[:3, 3], order=order, device="cpu")
    along = np.empty((len(u), 3, 3))
    for p, q in np.ndindex(3, 3):
        along[:, p, q] = tensor_interpolant(grid.at, u, order, tuple(np.eye(3, dtype=int)[p] + np.eye(3, dtype=int)[q]))
    inverse = np.linalg.inv(SHEARED[:3, :3])
    expected = inverse.T @ along @ inverse
    scale = max(1.0, *(float(np.abs(v).max()) for v in (grid.leaves, grid.background, grid.lower_tile)))
    # Entries of the inverse up to 3.4, twice; second differences up to 8 times the values.
    tolerance = (DECODING if grid_type in QUANTIZED else 1e-12) * scale * 100
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(np.transpose(found, (0, 2, 1)), found)


@pytest.mark.parametrize("order", ORDERS)
def test_quadratic_fields_have_their_exact_curvatures(order):
    # x^2 + y^2 + z^2 is exact in float32 at voxels and reproduced by both interpolants: no error but rounding is left.
    volume = field_grid(lambda ijk: (ijk**2).sum(axis=-1), 2)
    points = np.random.default_rng(1).uniform(-8, 8, (500, 3))
    radius = np.linalg.norm(points, axis=1)
    second = hessian(volume, points, order=order, device="cpu")
    np.testing.assert_allclose(second, np.broadcast_to(2 * np.eye(3), second.shape), rtol=0, atol=1e-11)
    found = curvature(volume, points, order=order, device="cpu")
    np.testing.assert_allclose(found.mean * radius, 1.0, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.gaussian * radius**2, 1.0, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.principal * radius[:, None], 1.0, rtol=0, atol=1e-11)


def test_signs_and_order_of_the_principal_curvatures():
    # A saddle: along x the level set bends away from larger values, along y towards them.
    volume = field_grid(lambda ijk: ijk[..., 2] * 8.0 + ijk[..., 0] ** 2 - 3.0 * ijk[..., 1] ** 2, 1)
    found = curvature(volume, [[0.0, 0.0, 0.0]], device="cpu")
    np.testing.assert_allclose(found.principal, [[2 / 8, -6 / 8]], rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.mean, [-2 / 8], rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.gaussian, [-12 / 64], rtol=0, atol=1e-14)
    # A field of the other sign has the curvatures of the other side.
    other = field_grid(lambda ijk: -(ijk[..., 2] * 8.0 + ijk[..., 0] ** 2 - 3.0 * ijk[..., 1] ** 2), 1)
    flipped = curvature(other, [[0.0, 0.0, 0.0]], device="cpu")
    np.testing.assert_allclose(flipped.principal, [[6 / 8, -2 / 8]], rtol=0, atol=1e-14)


def test_world_units():
    transform = np.diag([0.25, 0.25, 0.25, 1.0])
    transform[:3, 3] = [5.0, -3.0, 1.0]
    volume = field_grid(lambda ijk: np.linalg.norm(ijk * 0.25, axis=-1) - 3.0, 2, transform)
    found = curvature(volume, transform[:3, 3] + 3.0 * _directions(), device="cpu")
    # Of 12 voxels a radius.
    assert np.sqrt(((found.mean * 3.0 - 1.0) ** 2).mean()) < 0.3 / 12
    assert np.sqrt(((found.gaussian * 9.0 - 1.0) ** 2).mean()) < 0.6 / 12


# The bounds of curvature()'s docstring: relative to 1 / r, times the radius in voxels.
RMS_MEAN, LARGEST_MEAN, RMS_GAUSSIAN, RMS_PRINCIPAL = 0.3, 1.2, 0.6, 0.45


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("radius", [5, 10, 20, 40])
def test_sphere(radius, order):
    volume = field_grid(lambda ijk: np.linalg.norm(ijk, axis=-1) - radius, radius // 8 + 2)
    found = curvature(volume, radius * _directions(), order=order, device="cpu")
    mean, principal = found.mean * radius - 1, found.principal * radius - 1
    assert np.sqrt((mean**2).mean()) < RMS_MEAN / radius
    assert np.abs(mean).max() < LARGEST_MEAN / radius
    assert np.sqrt(((found.gaussian * radius**2 - 1) ** 2).mean()) < RMS_GAUSSIAN / radius
    assert np.sqrt((principal**2).mean()) < RMS_PRINCIPAL / radius


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(("ring", "tube"), [(20, 8), (40, 16)])
def test_torus(ring, tube, order):
    def distance(ijk):
        return np.hypot(np.hypot(ijk[..., 0], ijk[..., 1]) - ring, ijk[..., 2]) - tube

    volume = field_grid(distance, (ring + tube) // 8 + 1)
    around, across = np.random.default_rng(2).uniform(0, 2 * np.pi, (2, 4000))
    rho = ring + tube * np.cos(across)
    points = np.stack([rho * np.cos(around), rho * np.sin(around), tube * np.sin(across)], axis=-1)
    expected = np.stack([np.full(len(rho), 1 / tube), np.cos(across) / rho], axis=-1)
    found = curvature(volume, points, order=order, device="cpu")
    mean = (found.mean - expected.mean(axis=1)) * tube
    assert np.sqrt((mean**2).mean()) < RMS_MEAN / tube
    assert np.abs(mean).max() < LARGEST_MEAN / tube
    gaussian = (found.gaussian - expected.prod(axis=1)) * tube**2
    assert np.sqrt((gaussian**2).mean()) < RMS_GAUSSIAN / tube
    principal = (found.principal - expected) * tube
    assert np.sqrt((principal**2).mean()) < RMS_PRINCIPAL / tube


@pytest.mark.parametrize("order", ORDERS)
def test_hessian_is_the_derivative_of_the_gradient(order):
    volume = field_grid(lambda ijk: np.random.default_rng(4).normal(size=ijk.shape[:-1]), 1, SHEARED)
    u = np.floor(np.random.default_rng(5).uniform(-6, 6, (100, 3))) + 0.5
    points = u @ SHEARED[:3, :3].T + SHEARED[:3, 3]
    second = hessian(volume, points, order=order, device="cpu")
    # Inside a cell the gradient is a polynomial of degree 3 at most: central differences over small steps.
    step = 1e-5
    for axis in range(3):
        ends = [gradient(volume, points + s * step * np.eye(3)[axis], order=order, device="cpu") for s in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(second[:, axis], difference, rtol=0, atol=1e-6 * np.abs(second).max())


def test_no_slope_no_curvature():
    volume = field_grid(lambda ijk: np.full(ijk.shape[:-1], 2.0), 1)
    found = curvature(volume, [[0.3, 0.2, 0.1], [3e9, 0.0, 0.0]], device="cpu")
    for part in found:
        assert np.isnan(part).all()
    assert not hessian(volume, [[0.3, 0.2, 0.1], [3e9, 0.0, 0.0]], device="cpu").any()


@pytest.mark.parametrize("scale", [1e-150, 1e150])
def test_gradients_whose_squares_have_no_place_in_float64(scale):
    grid = field_grid(lambda ijk: (ijk**2).sum(axis=-1), 1, np.diag([scale, scale, scale, 1.0]))
    found = curvature(grid, np.array([[3.0, 2.0, 1.0]]) * scale, device="cpu")
    np.testing.assert_allclose(found.mean * scale, 1 / np.sqrt(14), rtol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_containers(dtype):
    import warp as wp

    volume = field_grid(lambda ijk: np.linalg.norm(ijk, axis=-1) - 6, 1)
    points = (6 * _directions(20)).astype(dtype)
    found, second = curvature(volume, points, device="cpu"), hessian(volume, points, device="cpu")
    assert isinstance(found, Curvatures)
    assert [part.shape for part in (*found, second)] == [(20,), (20,), (20, 2), (20, 3, 3)]
    assert all(part.dtype == dtype for part in (*found, second))
    given = wp.array(points, dtype=wp.vec3f if dtype == np.float32 else wp.vec3d, device="cpu")
    again, matrices = curvature(volume, given), hessian(volume, given)
    assert all(isinstance(part, wp.array) for part in (*again, matrices))
    for ours, theirs in zip((*found, second), (*again, matrices), strict=True):
        np.testing.assert_array_equal(ours, theirs.numpy())
    assert hessian(volume, np.empty((0, 3)), device="cpu").shape == (0, 3, 3)
    assert curvature(volume, np.empty((0, 3)), device="cpu").principal.shape == (0, 2)


@pytest.mark.parametrize("function", [hessian, curvature])
class TestRefusals:
    @pytest.mark.parametrize("order", [0, 1, 4, True, "3", None])
    def test_order(self, function, order):
        with pytest.raises(InputError, match=r"order: .* is not supported; use one of 2 \(triquadratic\)"):
            function(TypedGrid("float").volume, np.zeros((1, 3)), order=order, device="cpu")

    @pytest.mark.parametrize("grid_type", VECTORS)
    def test_vectors(self, function, grid_type):
        with pytest.raises(UnsupportedGridError, match=f"of type {grid_type} has no Hessian"):
            function(TypedGrid(grid_type).volume, np.zeros((1, 3)), device="cpu")

    def test_points(self, function):
        volume = TypedGrid("float").volume
        with pytest.raises(InputError, match="row 1"):
            function(volume, [[0.0, 0.0, 0.0], [0.0, np.inf, 0.0]], device="cpu")
        with pytest.raises(InputError, match="points: shape"):
            function(volume, np.zeros((4, 2)), device="cpu")
