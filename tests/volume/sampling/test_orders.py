"""Orders 2 and 3 against the interpolants computed in NumPy, for every grid type that NanoVDB stores."""

from __future__ import annotations

import importlib
import itertools

import numpy as np
import pytest

from benchmarks.catalog.float_grids import build_float_grid
from benchmarks.catalog.typed_grids import QUANTIZED, VALUED, TypedGrid
from geokit.errors import InputError
from geokit.volume.at_points.sample import gradient, sample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import HEAD_SIZE, aligned_buffer, info_of
from geokit.volume.nanovdb.layout import LAYOUTS
from tests.support.reference import tensor_interpolant

# Up to 64 products whose weights add up to 1.95 in absolute value: some tens of roundings of 1.1e-16.
ROUNDING = 1e-13
# Quantized voxels are decoded in float32, with or without a fused multiply-add.
DECODING = 1e-6
SHEARED = np.array([[0.5, 0.2, 0.0, 3.0], [-0.1, 0.25, 0.3, -7.0], [0.0, 0.1, 2.0, 11.0], [0.0, 0.0, 0.0, 1.0]])
ORDERS = (2, 3)
UNIT = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


def _points(count=200):
    """Index coordinates in and around the leaves and tiles, many of them where the stencil crosses borders."""
    rng = np.random.default_rng(3)
    near = rng.uniform([-11, -3, -3], [11, 11, 19], (count, 3))
    upper = rng.uniform([-3, -3, 125], [131, 131, 259], (count // 4, 3))
    root = rng.uniform([4093, -3, -3], [4099, 3, 3], (count // 4, 3))
    corner = rng.uniform(-2.5, 2.5, (count // 2, 3)) + rng.choice([-8, 0, 8], (count // 2, 3))
    return np.concatenate([near, upper, root, corner])


def _to_world(transform, u):
    return u @ transform[:3, :3].T + transform[:3, 3]


def _scale(grid):
    finite = [np.abs(v).max() for v in (grid.leaves, grid.background, grid.lower_tile, grid.upper_tile, grid.root_tile)]
    return max(1.0, *map(float, finite))


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("grid_type", VALUED)
class TestEveryType:
    @pytest.mark.slow
    def test_values(self, grid_type, order):
        grid, u = TypedGrid(grid_type), _points()
        found = sample(grid.volume, u, order=order, device="cpu")
        expected = tensor_interpolant(grid.at, u, order)
        assert found.shape == expected.shape
        tolerance = (DECODING if grid_type in QUANTIZED else ROUNDING) * _scale(grid)
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)

    @pytest.mark.slow
    def test_gradient_in_a_sheared_grid(self, grid_type, order):
        grid, u = TypedGrid(grid_type, SHEARED), _points(100)
        found = gradient(grid.volume, _to_world(SHEARED, u), order=order, device="cpu")
        along = np.stack([tensor_interpolant(grid.at, u, order, unit) for unit in UNIT], axis=-1)
        expected = along @ np.linalg.inv(SHEARED[:3, :3])
        assert found.shape == expected.shape
        # The points were rounded on their way to the world and back: 1e-14 of a voxel, times second differences.
        tolerance = (DECODING if grid_type in QUANTIZED else 1e-12) * _scale(grid) * 10
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)

    def test_voxel_centers_give_the_stored_values(self, grid_type, order):
        grid = TypedGrid(grid_type)
        ijk = np.round(_points()).astype(np.int64)
        found = sample(grid.volume, ijk.astype(float), order=order, device="cpu")
        if grid_type in QUANTIZED:
            np.testing.assert_allclose(found, grid.at(ijk), rtol=DECODING, atol=DECODING)
        else:
            np.testing.assert_array_equal(found, grid.at(ijk))

    def test_beyond_int32_is_background(self, grid_type, order):
        grid = TypedGrid(grid_type)
        far = np.array([[3e9, 0, 0], [0, -2147483649.0, 0], [0, 0, 1e300], [-1e308, 1e308, 1e308]])
        found = sample(grid.volume, far, order=order, device="cpu")
        np.testing.assert_array_equal(found, np.broadcast_to(grid.background, found.shape))
        assert not gradient(grid.volume, far, order=order, device="cpu").any()


def _field_grid(values, transform=None, background=0.0):
    """A float grid whose dense ``values`` (a multiple of 8 along each axis) start at voxel (0, 0, 0)."""
    blocks = np.array(values.shape) // 8
    leaves = values.reshape(blocks[0], 8, blocks[1], 8, blocks[2], 8).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 512)
    origins = np.stack(np.meshgrid(*map(np.arange, blocks), indexing="ij"), axis=-1).reshape(-1, 3) * 8
    buffer = build_float_grid(
        origins.astype(np.int32),
        leaves.astype(np.float32),
        np.ones((len(leaves), 512), bool),
        background=background,
        transform=np.eye(4) if transform is None else transform,
        name="field",
        grid_class="unknown",
        signed_fill=False,
    )
    return SparseVolume(buffer, info_of(buffer))


def test_every_phase_of_the_stencil_in_a_leaf():
    # 16^3 positions of the stencil: each split of rows, columns and slabs between leaves.
    dense = np.random.default_rng(1).normal(size=(24, 24, 24)).astype(np.float32)
    volume = _field_grid(dense, background=0.75)

    def at(ijk):
        inside = ((ijk >= 0) & (ijk < 24)).all(axis=1)
        out = np.full(len(ijk), 0.75)
        out[inside] = dense[tuple(ijk[inside].T)]
        return out

    u = np.array(list(np.ndindex(16, 16, 16))) + np.random.default_rng(2).uniform(0, 1, (4096, 3))
    for order in ORDERS:
        found = sample(volume, u, order=order, device="cpu")
        np.testing.assert_allclose(found, tensor_interpolant(at, u, order), rtol=0, atol=1e-14)
        slopes = gradient(volume, u, order=order, device="cpu")
        for axis, unit in enumerate(UNIT):
            expected = tensor_interpolant(at, u, order, unit)
            np.testing.assert_allclose(slopes[:, axis], expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("order", ORDERS)
def test_constant_region_is_exact(order):
    volume = _field_grid(np.full((8, 8, 8), 0.1, np.float32), background=np.float32(0.1))
    points = np.random.default_rng(0).uniform(-20, 30, (500, 3))
    assert (sample(volume, points, order=order, device="cpu") == float(np.float32(0.1))).all()
    assert not gradient(volume, points, order=order, device="cpu").any()


@pytest.mark.parametrize("order", ORDERS)
def test_one_voxel_that_is_not_finite_spoils_the_stencils_around_it_only(order):
    dense = np.zeros((16, 16, 16), np.float32)
    dense[7, 7, 7] = np.inf
    volume = _field_grid(dense)
    u = np.random.default_rng(0).uniform(3, 12, (2000, 3))
    base = np.floor(u).astype(int)
    reached = ((base <= 8) & (base + order - 1 >= 7)).all(axis=1)
    assert 0.01 < reached.mean() < 0.9
    np.testing.assert_array_equal(~np.isfinite(sample(volume, u, order=order, device="cpu")), reached)
    slopes = gradient(volume, u, order=order, device="cpu")
    np.testing.assert_array_equal(~np.isfinite(slopes).all(axis=1), reached)


def test_an_infinite_background_is_returned_where_there_are_no_voxels():
    plain = _field_grid(np.zeros((8, 8, 8), np.float32))
    buffer = aligned_buffer(len(plain.nanovdb))
    buffer[:] = plain.nanovdb
    at = HEAD_SIZE + LAYOUTS["float"].root_background
    buffer[at : at + 4].view("<f4")[0] = np.inf
    volume = SparseVolume(buffer, info_of(buffer))
    for order in ORDERS:
        assert sample(volume, [[3.5, 3.5, 3.5]], order=order, device="cpu") == [0.0]
        assert sample(volume, [[3e9, 0.0, 0.0]], order=order, device="cpu") == [np.inf]


def test_order_2_by_hand():
    dense = np.zeros((8, 8, 8), np.float32)
    dense[2:5] = np.array([1.0, 4.0, 2.0], np.float32)[:, None, None]
    volume = _field_grid(dense)
    # The parabola through 1, 4, 2 half way between the last two: weights -1/8, 6/8, 3/8, of its slope 0, -1, 1.
    assert sample(volume, [[3.5, 4.0, 4.0]], order=2, device="cpu") == [-1 / 8 + 6 / 8 * 4 + 3 / 8 * 2]
    np.testing.assert_array_equal(gradient(volume, [[3.5, 4.0, 4.0]], order=2, device="cpu"), [[-2.0, 0.0, 0.0]])


def test_order_3_by_hand():
    dense = np.zeros((8, 8, 8), np.float32)
    dense[2:6] = np.array([1.0, 4.0, 2.0, 3.0], np.float32)[:, None, None]
    volume = _field_grid(dense)
    # Catmull-Rom half way between 4 and 2: weights -1/16, 9/16, 9/16, -1/16, of its slope 1/8, -11/8, 11/8, -1/8.
    assert sample(volume, [[3.5, 4.0, 4.0]], order=3, device="cpu") == [(-1 + 9 * 4 + 9 * 2 - 3) / 16]
    found = gradient(volume, [[3.5, 4.0, 4.0]], order=3, device="cpu")
    np.testing.assert_array_equal(found, [[(1 - 11 * 4 + 11 * 2 - 3) / 8, 0.0, 0.0]])


STEP = 1e-9


class TestContinuity:
    """Across the borders of cells: order 2 is continuous, order 3 has a continuous gradient as well."""

    @pytest.fixture
    def sides(self):
        volume = _field_grid(np.random.default_rng(4).normal(size=(24, 24, 24)))
        rng = np.random.default_rng(5)
        u = rng.uniform(2, 21, (600, 3))
        axis = rng.integers(0, 3, 600)
        rows = np.arange(600)
        u[rows, axis] = np.round(u[rows, axis])
        step = np.zeros_like(u)
        step[rows, axis] = STEP
        return volume, u - step, u + step

    @pytest.mark.parametrize("order", ORDERS)
    def test_values(self, sides, order):
        volume, below, above = sides
        jump = sample(volume, below, order=order, device="cpu") - sample(volume, above, order=order, device="cpu")
        # Slopes of a random field stay below 30.
        assert np.abs(jump).max() < 30 * 2 * STEP

    def test_gradients(self, sides):
        volume, below, above = sides
        jumps = {
            order: np.abs(
                gradient(volume, below, order=order, device="cpu") - gradient(volume, above, order=order, device="cpu")
            ).max()
            for order in (1, 2, 3)
        }
        assert jumps[3] < 100 * 2 * STEP
        # The other two do jump: the test can fail.
        assert min(jumps[1], jumps[2]) > 0.1


class TestConvergence:
    """A smooth field on finer and finer grids."""

    @staticmethod
    def _field(x, y, z):
        return np.sin(1.3 * x + 0.4) * np.cos(0.9 * y - 0.2) + np.sin(0.7 * z + 0.5 * x)

    @staticmethod
    def _slope(x, y, z):
        a, b, c = 1.3 * x + 0.4, 0.9 * y - 0.2, 0.7 * z + 0.5 * x
        return np.stack(
            [1.3 * np.cos(a) * np.cos(b) + 0.5 * np.cos(c), -0.9 * np.sin(a) * np.sin(b), 0.7 * np.cos(c)], axis=-1
        )

    def _errors(self, count, order):
        h = 4.0 / count
        transform = np.diag([h, h, h, 1.0])
        axis = np.arange(count) * h
        x, y, z = np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)
        volume = _field_grid(self._field(x, y, z), transform)
        points = np.random.default_rng(6).uniform(1.0, 2.5, (4000, 3))
        value = np.abs(sample(volume, points, order=order, device="cpu") - self._field(*points.T)).max()
        slope = np.abs(gradient(volume, points, order=order, device="cpu") - self._slope(*points.T)).max()
        return value, slope

    @pytest.mark.parametrize("order", ORDERS)
    def test_values_are_of_third_order_and_gradients_of_second(self, order):
        values, slopes = zip(*(self._errors(count, order) for count in (16, 32, 64)), strict=True)
        # Rounding the voxels to float32 costs 1e-7, the finest grid's errors are a hundred times that.
        for coarse, fine in itertools.pairwise(values):
            assert 6.5 < coarse / fine < 9.5
        for coarse, fine in itertools.pairwise(slopes):
            assert 3.2 < coarse / fine < 4.8


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_precision_of_the_points_is_that_of_the_result(order, dtype):
    volume = _field_grid(np.random.default_rng(5).normal(size=(16, 16, 16)))
    points = np.random.default_rng(6).uniform(0, 15, (50, 3)).astype(dtype)
    reference = sample(volume, points.astype(np.float64), order=order, device="cpu")
    found = sample(volume, points, order=order, device="cpu")
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, reference.astype(dtype))
    assert gradient(volume, points, order=order, device="cpu").dtype == dtype


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(("grid_type", "tail"), [("float", ()), ("vec3f", (3,)), ("vec4d", (4,))])
def test_containers(order, grid_type, tail):
    import warp as wp

    volume, points = TypedGrid(grid_type).volume, _points(40)
    assert sample(volume, np.empty((0, 3)), order=order, device="cpu").shape == (0, *tail)
    assert gradient(volume, np.empty((0, 3)), order=order, device="cpu").shape == (0, *tail, 3)
    given = wp.array(points, dtype=wp.float64, device="cpu")
    found = sample(volume, given, order=order)
    assert isinstance(found, wp.array)
    np.testing.assert_array_equal(found.numpy(), sample(volume, points, order=order, device="cpu"))
    slopes = gradient(volume, given, order=order)
    np.testing.assert_array_equal(slopes.numpy(), gradient(volume, points, order=order, device="cpu"))


class TestIndexSpace:
    """Points, and derivatives, in units of voxels instead of world."""

    TRANSFORM = np.array([[0.1, 0.02, 0.0, 3.0], [0.0, -0.2, 0.01, -1.0], [0.03, 0.0, 0.15, 0.5], [0.0, 0.0, 0.0, 1.0]])

    def _volume(self):
        values = np.random.default_rng(0).normal(size=(1, 512)).astype(np.float32)
        buffer = build_float_grid(
            np.zeros((1, 3), np.int32), values, np.ones((1, 512), bool), background=0.0, transform=self.TRANSFORM,
            name="", grid_class="unknown", signed_fill=False,
        )  # fmt: skip
        return SparseVolume(buffer, info_of(buffer, {}))

    @pytest.mark.parametrize("order", [0, 1, 2, 3])
    def test_values_and_derivatives(self, order):
        volume = self._volume()
        index = np.random.default_rng(1).uniform(1.0, 6.0, (50, 3))
        linear = self.TRANSFORM[:3, :3]
        world = index @ linear.T + self.TRANSFORM[:3, 3]
        found = volume.sample(index, order=order, space="index", device="cpu")
        np.testing.assert_allclose(found, volume.sample(world, order=order, device="cpu"), atol=1e-9)
        slopes = volume.gradient(index, order=order, space="index", device="cpu")
        np.testing.assert_allclose(slopes, volume.gradient(world, order=order, device="cpu") @ linear, atol=1e-8)
        assert (volume.active_at(index, space="index", device="cpu")).all()
        if order >= 2:
            second = volume.hessian(index, order=order, space="index", device="cpu")
            expected = linear.T @ volume.hessian(world, order=order, device="cpu") @ linear
            np.testing.assert_allclose(second, expected, atol=1e-7)

    def test_unknown_space_is_refused(self):
        volume = self._volume()
        for query in (volume.sample, volume.gradient, volume.active_at, volume.hessian):
            with pytest.raises(InputError, match="space: 'local' is not known"):
                query(np.zeros((1, 3)), space="local", device="cpu")


@pytest.mark.parametrize(
    "name",
    [
        "sampling.sample",
        "sampling.staggered",
        "sampling.stencil",
        "sampling.smooth",
        "sampling.curvature",
        "sampling.differential",
        "sampling.trilinear_table",
        "adaptive.sample",
    ],
)
def test_no_kernel_fuses_products_with_sums(name):
    # Fused products round differently: answers of a GPU would not be those of a CPU.
    import warp as wp

    module = importlib.import_module(f"geokit.volume.{name}_kernels")
    assert wp.get_module(module.__name__).options["fuse_fp"] is False
