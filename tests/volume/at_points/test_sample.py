"""Sampling against values and interpolants computed in NumPy, for every grid type that NanoVDB stores."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from benchmarks.catalog.float_grids import build_float_grid
from benchmarks.catalog.typed_grids import QUANTIZED, VALUED, TypedGrid
from geokit import native
from geokit.errors import GeokitError, InputError, UnsupportedGridError
from geokit.volume.at_points.sample import gradient, sample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import aligned_buffer, info_of, tree_header
from geokit.volume.nanovdb.layout import GRID_TYPES

# Seven float64 interpolations and three of the coordinates: some tens of roundings of 1.1e-16, values below 300.
ROUNDING = 1e-12
# Quantized voxels are decoded in float32, with or without a fused multiply-add.
DECODING = 1e-6


def _trilinear(at, u):
    """The trilinear interpolant as a sum of eight products; ``at`` gives the values of voxels (N, 3)."""
    base = np.floor(u)
    total = 0.0
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, u - base, 1 - (u - base)), axis=1)
        value = at(base.astype(np.int64) + corner)
        total = total + weight.reshape(-1, *[1] * (value.ndim - 1)) * value
    return total


def _index_gradient(at, u):
    """Its derivatives along the index axes, last axis of the result."""
    base = np.floor(u)
    f = u - base
    parts = []
    for axis in range(3):
        total = 0.0
        for corner in np.ndindex(2, 2, 2):
            factors = np.where(corner, f, 1 - f)
            factors[:, axis] = 1.0 if corner[axis] else -1.0
            value = at(base.astype(np.int64) + corner)
            total = total + np.prod(factors, axis=1).reshape(-1, *[1] * (value.ndim - 1)) * value
        parts.append(total)
    return np.stack(parts, axis=-1)


def _points(count=400):
    """Index coordinates in and around the leaves and tiles, many of them in cells that cross borders."""
    rng = np.random.default_rng(3)
    near = rng.uniform([-10, -2, -2], [10, 10, 18], (count, 3))
    upper = rng.uniform([-2, -2, 126], [130, 130, 258], (count // 4, 3))
    root = rng.uniform([4094, -2, -2], [4098, 2, 2], (count // 4, 3))
    corner = rng.uniform(-1.5, 1.5, (count // 4, 3)) + rng.choice([-8, 0, 8], (count // 4, 3))
    return np.concatenate([near, upper, root, corner])


SHEARED = np.array([[0.5, 0.2, 0.0, 3.0], [-0.1, 0.25, 0.3, -7.0], [0.0, 0.1, 2.0, 11.0], [0.0, 0.0, 0.0, 1.0]])


def _to_world(transform, u):
    return u @ transform[:3, :3].T + transform[:3, 3]


def _scale(grid):
    finite = [np.abs(v).max() for v in (grid.leaves, grid.background, grid.lower_tile, grid.upper_tile, grid.root_tile)]
    return max(1.0, *map(float, finite))


@pytest.mark.parametrize("grid_type", VALUED)
class TestEveryType:
    def test_order_0_gives_every_stored_value(self, grid_type):
        grid = TypedGrid(grid_type)
        ijk = np.round(_points()).astype(np.int64)
        found = sample(grid.volume, ijk.astype(float), order=0, device="cpu")
        expected = grid.at(ijk)
        assert found.shape == expected.shape
        if grid_type in QUANTIZED:
            np.testing.assert_allclose(found, expected, rtol=DECODING, atol=DECODING)
        else:
            np.testing.assert_array_equal(found, expected)

    def test_order_1_is_trilinear(self, grid_type):
        grid = TypedGrid(grid_type)
        u = _points()
        found = sample(grid.volume, u, order=1, device="cpu")
        tolerance = (DECODING if grid_type in QUANTIZED else ROUNDING) * _scale(grid)
        np.testing.assert_allclose(found, _trilinear(grid.at, u), rtol=0, atol=tolerance)

    def test_gradient_of_order_1_in_a_sheared_grid(self, grid_type):
        grid = TypedGrid(grid_type, SHEARED)
        u = _points(100)
        found = gradient(grid.volume, _to_world(SHEARED, u), device="cpu")
        expected = _index_gradient(grid.at, u) @ np.linalg.inv(SHEARED[:3, :3])
        assert found.shape == expected.shape
        # Points within a rounding of a cell's border may fall to either side: random ones do not.
        tolerance = (DECODING if grid_type in QUANTIZED else 1e-11) * _scale(grid) * 10
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)

    def test_gradient_of_order_0_is_central_differences(self, grid_type):
        grid = TypedGrid(grid_type, SHEARED)
        u = _points(100)
        nearest = np.floor(u + 0.5).astype(np.int64)
        steps = np.eye(3, dtype=np.int64)
        differences = np.stack([(grid.at(nearest + e) - grid.at(nearest - e)) / 2 for e in steps], axis=-1)
        found = gradient(grid.volume, _to_world(SHEARED, u), order=0, device="cpu")
        tolerance = (DECODING if grid_type in QUANTIZED else 1e-13) * _scale(grid) * 10
        np.testing.assert_allclose(found, differences @ np.linalg.inv(SHEARED[:3, :3]), rtol=0, atol=tolerance)

    def test_beyond_int32_is_background(self, grid_type):
        grid = TypedGrid(grid_type)
        far = np.array([[3e9, 0, 0], [0, -2147483649.0, 0], [0, 0, 1e300], [-1e308, 1e308, 1e308]])
        for order in (0, 1):
            found = sample(grid.volume, far, order=order, device="cpu")
            np.testing.assert_array_equal(found, np.broadcast_to(grid.background, found.shape))
            assert not gradient(grid.volume, far, order=order, device="cpu").any()


def _field_grid(values, lower, transform=None, background=0.0):
    """A float grid whose dense ``values`` start at voxel ``lower`` (a multiple of 8, as is the shape)."""
    blocks = np.array(values.shape) // 8
    leaves = values.reshape(blocks[0], 8, blocks[1], 8, blocks[2], 8).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 512)
    origins = np.stack(np.meshgrid(*map(np.arange, blocks), indexing="ij"), axis=-1).reshape(-1, 3) * 8 + lower
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


class TestFloatGrids:
    @pytest.mark.parametrize("lower", [(0, 0, 0), (-16, -8, -24), (-8, 4088, 120)])
    def test_dense_field_across_leaf_and_node_borders(self, lower):
        rng = np.random.default_rng(1)
        dense = rng.normal(size=(24, 16, 24)).astype(np.float32)
        volume = _field_grid(dense, np.array(lower), background=0.75)

        def at(ijk):
            local = ijk - lower
            inside = ((local >= 0) & (local < dense.shape)).all(axis=1)
            out = np.full(len(ijk), 0.75)
            out[inside] = dense[tuple(local[inside].T)]
            return out

        u = rng.uniform(-2, np.array(dense.shape) + 1, (3000, 3)) + lower
        np.testing.assert_allclose(sample(volume, u, device="cpu"), _trilinear(at, u), rtol=0, atol=ROUNDING)
        nearest = at(np.floor(u + 0.5).astype(np.int64))
        np.testing.assert_array_equal(sample(volume, u, order=0, device="cpu"), nearest)

    def test_halves_round_up(self):
        dense = np.arange(8.0)[:, None, None] + np.zeros((8, 8, 8))
        volume = _field_grid(dense, np.array([-8, 0, 0]))
        found = sample(volume, [[-7.5, 4, 4], [-6.5, 4, 4], [-2.5, 4, 4]], order=0, device="cpu")
        np.testing.assert_array_equal(found, [1, 2, 6])

    def test_constant_region_is_exact(self):
        volume = _field_grid(np.full((8, 8, 8), 0.1, np.float32), np.zeros(3, int), background=np.float32(0.1))
        points = np.random.default_rng(0).uniform(-20, 30, (500, 3))
        assert (sample(volume, points, device="cpu") == float(np.float32(0.1))).all()
        assert not gradient(volume, points, device="cpu").any()

    def test_methods_of_the_volume(self):
        volume = _field_grid(np.random.default_rng(0).normal(size=(8, 8, 8)), np.zeros(3, int))
        points = np.array([[1.5, 2.25, 3.75]])
        np.testing.assert_array_equal(volume.sample(points, device="cpu"), sample(volume, points, device="cpu"))
        np.testing.assert_array_equal(
            volume.gradient(points, order=0, device="cpu"), gradient(volume, points, order=0, device="cpu")
        )


class TestSphere:
    """A signed distance field sampled away from its medial axis."""

    CENTER = np.array([0.31, -0.17, 0.23])

    def _errors(self, voxel_size):
        count = round(4.0 / voxel_size)
        transform = np.diag([voxel_size] * 3 + [1.0])
        transform[:3, 3] = -2.0
        axis = np.arange(count) * voxel_size - 2.0
        x, y, z = np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)
        distance = np.sqrt((x - self.CENTER[0]) ** 2 + (y - self.CENTER[1]) ** 2 + (z - self.CENTER[2]) ** 2) - 1.0
        volume = _field_grid(distance, np.zeros(3, int), transform)
        rng = np.random.default_rng(2)
        normals = rng.normal(size=(20_000, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        height = rng.uniform(-0.2, 0.2, (len(normals), 1))
        points = self.CENTER + normals * (1.0 + height)
        value = np.abs(sample(volume, points, device="cpu") - height[:, 0]).max()
        slope = np.abs(gradient(volume, points, device="cpu") - normals).max()
        return value, slope

    def test_value_converges_at_second_order_and_gradient_at_first(self):
        values, slopes = zip(*(self._errors(h) for h in (0.125, 0.0625, 0.03125)), strict=True)
        # The interpolant's error is at most 3/8 h^2 times the curvature, which is 1/0.8 at the innermost points.
        assert values[0] <= 0.375 * 0.125**2 / 0.8
        for coarse, fine in itertools.pairwise(values):
            assert 3.5 < coarse / fine < 4.5
        for coarse, fine in itertools.pairwise(slopes):
            assert 1.7 < coarse / fine < 2.4


class TestContainers:
    @pytest.fixture
    def volume(self):
        return _field_grid(np.random.default_rng(5).normal(size=(16, 16, 16)), np.zeros(3, int))

    def test_no_points(self, volume):
        assert sample(volume, np.empty((0, 3)), device="cpu").shape == (0,)
        assert gradient(volume, np.empty((0, 3)), device="cpu").shape == (0, 3)
        vectors = TypedGrid("vec4f").volume
        assert sample(vectors, np.empty((0, 3)), device="cpu").shape == (0, 4)
        assert gradient(vectors, np.empty((0, 3)), device="cpu").shape == (0, 4, 3)

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_precision_of_the_points_is_that_of_the_result(self, volume, dtype):
        points = np.random.default_rng(6).uniform(0, 15, (50, 3)).astype(dtype)
        reference = sample(volume, points.astype(np.float64), device="cpu")
        found = sample(volume, points, device="cpu")
        assert found.dtype == dtype
        np.testing.assert_array_equal(found, reference.astype(dtype))
        assert gradient(volume, points, device="cpu").dtype == dtype

    @pytest.mark.parametrize(("grid_type", "tail"), [("float", ()), ("vec3f", (3,)), ("vec4d", (4,))])
    def test_warp_in_warp_out(self, grid_type, tail):
        import warp as wp

        volume = TypedGrid(grid_type).volume
        points = _points(40)
        given = wp.array(points, dtype=wp.float64, device="cpu")
        found = sample(volume, given)
        assert isinstance(found, wp.array)
        assert found.shape == (len(points), *tail)
        np.testing.assert_array_equal(found.numpy(), sample(volume, points, device="cpu"))
        slopes = gradient(volume, given)
        assert slopes.shape == (len(points), *tail, 3)
        np.testing.assert_array_equal(slopes.numpy(), gradient(volume, points, device="cpu"))


class TestRefusals:
    @pytest.fixture
    def volume(self):
        return _field_grid(np.zeros((8, 8, 8)), np.zeros(3, int))

    @pytest.mark.parametrize("function", [sample, gradient])
    @pytest.mark.parametrize("order", [4, -1, True, 1.0, "1"])
    def test_order(self, volume, function, order):
        with pytest.raises(InputError, match=r"order: .* is not supported; use one of 0"):
            function(volume, [[0.0, 0.0, 0.0]], order=order, device="cpu")

    @pytest.mark.parametrize("function", [sample, gradient])
    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_point_that_is_not_finite(self, volume, function, bad):
        with pytest.raises(InputError, match="row 1"):
            function(volume, [[0.0, 0.0, 0.0], [0.0, bad, 0.0]], device="cpu")

    @pytest.mark.parametrize("function", [sample, gradient])
    def test_shape(self, volume, function):
        with pytest.raises(InputError, match="points: shape"):
            function(volume, np.zeros((4, 2)), device="cpu")

    @pytest.mark.parametrize("function", [sample, gradient])
    def test_device(self, volume, function):
        with pytest.raises(InputError, match="device"):
            function(volume, np.zeros((4, 3)), device="cuda:99")

    @pytest.mark.parametrize("function", [sample, gradient])
    @pytest.mark.parametrize("grid_type", ["index", "onindex", "indexmask", "onindexmask", "pointindex", "unknown"])
    def test_grids_without_values_are_named(self, volume, function, grid_type):
        other = SparseVolume(volume.nanovdb, dataclasses.replace(volume.info, grid_type=grid_type))
        with pytest.raises(UnsupportedGridError, match=f"of type {grid_type} stores no values"):
            function(other, np.zeros((1, 3)), device="cpu")

    def test_a_damaged_buffer_does_not_reach_the_kernels(self, volume):
        damaged = aligned_buffer(len(volume.nanovdb))
        damaged[:] = volume.nanovdb
        tree_header(damaged)["node_offset"][0] = 1 << 40
        with pytest.raises(GeokitError):
            sample(SparseVolume(damaged, volume.info), np.zeros((1, 3)), device="cpu")


def test_every_type_of_nanovdb_is_either_sampled_or_refused():
    refused = {"unknown", "index", "onindex", "indexmask", "onindexmask", "pointindex"}
    assert set(VALUED) == set(GRID_TYPES) - refused


@pytest.mark.slow
@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
@pytest.mark.parametrize(
    "grid_type", ["float", "double", "int32", "int64", "bool", "mask", "uint32", "vec3f", "vec3d", "vec4f", "vec4d"]
)
def test_buffers_that_nanovdb_itself_laid_out(grid_type, tmp_path):
    # Through OpenVDB and back: the nodes are then where NanoVDB's own code puts them.
    grid = TypedGrid(grid_type)
    native.write_vdb(tmp_path / "grid.vdb", [native.VdbGrid(grid.volume.nanovdb, {})])
    (read,) = native.read_vdb(tmp_path / "grid.vdb")
    volume = SparseVolume(read.nanovdb, info_of(read.nanovdb))
    assert volume.info.grid_type == grid_type
    inside = np.array(list(np.ndindex(16, 8, 8))) - [8, 0, 0]
    ijk = np.concatenate([inside, np.round(_points()).astype(np.int64)])
    np.testing.assert_array_equal(sample(volume, ijk.astype(float), order=0, device="cpu"), grid.at(ijk))
