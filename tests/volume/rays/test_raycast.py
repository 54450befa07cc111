"""Rays against levels of volumes, checked against a dense float64 search along each ray."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp

from benchmarks.catalog.sphere_volumes import sphere
from benchmarks.catalog.typed_grids import QUANTIZED, SCALARS, TypedGrid
from geokit import native
from geokit.core import launcher
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume._raycast import raycast
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import aligned_buffer, info_of
from geokit.volume.rays import crossing_blocks
from geokit.volume.rays.crossing_blocks_kernels import FARTHEST, spread_distance_kernel
from tests.support import reference
from tests.support.volume_rays import Field, assert_first_crossings, both_ways, rays_through

SHEARED = np.array([[0.3, 0.05, 0.0, 2.0], [0.0, -0.2, 0.04, -1.0], [0.02, 0.0, 0.5, 3.0], [0.0, 0.0, 0.0, 1.0]])


def _distance(shape, radius, lower=(0, 0, 0)):
    center = np.array(shape) / 2 + 0.3 + np.array(lower)
    ijk = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) + np.array(lower)
    return np.linalg.norm(ijk - center, axis=-1) - radius


@pytest.fixture(scope="module")
def rough():
    """Independent random voxels: crossings everywhere, often three in a cell."""
    return Field(np.random.default_rng(3).normal(size=(24, 16, 24)), lower=(-8, -8, 4088), background=0.4)


class TestFields:
    @pytest.mark.slow
    @pytest.mark.parametrize("isovalue", [0.0, 0.37, -1.1])
    def test_random_voxels(self, rough, isovalue, monkeypatch):
        start, toward = rays_through(rough.lower - 1.0, rough.lower + rough.dense.shape, 40, 0)
        hits = both_ways(monkeypatch, rough.volume, start, toward, isovalue=isovalue)
        assert_first_crossings(rough.at, start, toward, hits.t, isovalue=isovalue)
        assert np.isfinite(hits.t).mean() > 0.3
        # Past the first crossing lie the next ones, as for rays that start inside.
        later = raycast(rough.volume, start, toward, isovalue=isovalue, t_min=14.0, device="cpu")
        assert_first_crossings(rough.at, start, toward, later.t, isovalue=isovalue, first=14.0)

    @pytest.mark.slow
    @pytest.mark.parametrize("half_width", [1.0, 3.0])
    @pytest.mark.parametrize("scale", [1.0, 1000.0])
    def test_narrow_bands(self, half_width, scale, monkeypatch):
        # Only leaves that the band touches are stored: beyond them, inside as outside, there is the background.
        band = np.clip(_distance((48, 48, 48), 15.0), -half_width, half_width) * scale
        near = (np.abs(band) < half_width * scale).reshape(6, 8, 6, 8, 6, 8).any(axis=(1, 3, 5))
        field = Field(band, background=half_width * scale, stored=near)
        start, toward = rays_through(np.zeros(3), np.full(3, 47.0), 60, 1)
        hits = both_ways(monkeypatch, field.volume, start, toward)
        assert_first_crossings(field.at, start, toward, hits.t, size=scale)
        assert np.isfinite(hits.t).mean() > 0.4

    def test_a_level_beside_the_background(self, monkeypatch):
        # 0.7 lies between two float32 numbers, of which the field has one.
        field = Field(np.full((8, 8, 8), 0.7), background=0.7)
        start, toward = np.full((1, 3), 3.0), np.ones((1, 3))
        assert both_ways(monkeypatch, field.volume, start, toward, isovalue=0.7).t[0] == math.inf
        assert both_ways(monkeypatch, field.volume, start, toward, isovalue=float(np.float32(0.7))).t[0] == 0.0

    def test_level_set_with_an_inside(self, monkeypatch):
        volume = sphere(20.0)
        directions = np.random.default_rng(0).normal(size=(300, 3))
        inside = both_ways(monkeypatch, volume, np.zeros((300, 3)), directions)
        distance = inside.t * np.linalg.norm(directions, axis=1)
        # The interpolant of a sphere's distances is off by 3/8 of the curvature at most.
        np.testing.assert_allclose(distance, 20.0, atol=0.375 / 20)
        np.testing.assert_allclose(np.linalg.norm(inside.normals, axis=1), 1.0, atol=1e-14)
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        assert ((inside.normals * unit).sum(axis=1) > 0.99).all()
        outside = both_ways(monkeypatch, volume, 40.0 * unit, -unit)
        np.testing.assert_allclose(outside.points, inside.points, atol=1e-12)
        np.testing.assert_allclose(outside.normals, inside.normals, atol=1e-10)

    def test_fog(self, monkeypatch):
        fog = Field(np.clip(-_distance((32, 32, 32), 12.0) / 4.0, 0.0, 1.0), background=0.0)
        start, toward = rays_through(np.zeros(3), np.full(3, 31.0), 60, 2)
        hits = both_ways(monkeypatch, fog.volume, start, toward, isovalue=0.3)
        assert_first_crossings(fog.at, start, toward, hits.t, isovalue=0.3)
        assert np.isfinite(hits.t).mean() > 0.4

    def test_normals_are_gradients_in_world_space(self):
        field = Field(np.random.default_rng(5).normal(size=(16, 16, 16)), transform=SHEARED)
        start, toward = rays_through(np.zeros(3), np.full(3, 15.0), 200, 3)
        origins, directions = field.to_world(start, toward)
        hits = raycast(field.volume, origins, directions, isovalue=0.2, device="cpu")
        found = np.isfinite(hits.t)
        u = (hits.points[found] - SHEARED[:3, 3]) @ np.linalg.inv(SHEARED[:3, :3]).T
        # At a border two cells have a say; away from borders the gradient is that of a central difference.
        clear = (np.abs(u - np.round(u)) > 1e-3).all(axis=1) & (u > 0).all(axis=1) & (u < 15).all(axis=1)
        assert clear.sum() > 50
        slope = reference.trilinear_gradient(field.dense, u[clear]) @ np.linalg.inv(SHEARED[:3, :3])
        slope /= np.linalg.norm(slope, axis=1, keepdims=True)
        np.testing.assert_allclose(hits.normals[found][clear], slope, atol=1e-9)


class TestTypes:
    @pytest.mark.slow
    @pytest.mark.parametrize("grid_type", SCALARS + QUANTIZED)
    def test_leaves_and_tiles_of_every_type(self, grid_type, monkeypatch):
        grid = TypedGrid(grid_type)
        start, toward = rays_through(np.array([-9.0, -1.0, -1.0]), np.array([8.0, 8.0, 16.0]), 25, 4)
        values = grid.leaves.astype(np.float64)
        isovalue = 0.5 if grid_type in ("bool", "mask") else float(np.median(values)) + 0.01
        hits = both_ways(monkeypatch, grid.volume, start, toward, isovalue=isovalue)
        size = max(np.abs(values).max(), abs(float(grid.background)), 1.0)
        assert_first_crossings(grid.at, start, toward, hits.t, isovalue=isovalue, last=60.0, size=size)

    @pytest.mark.parametrize("axis", [0, 2])
    def test_tiles_of_upper_nodes_and_of_the_root(self, axis, monkeypatch):
        grid = TypedGrid("double")
        border, tile = (4096, grid.root_tile) if axis == 0 else (128, grid.upper_tile)
        isovalue = 0.75 * float(grid.background) + 0.25 * float(tile)
        start = np.full((1, 3), 60.5)
        start[0, axis] = border - 30.0
        toward = np.eye(3)[axis : axis + 1]
        hits = both_ways(monkeypatch, grid.volume, start, toward, isovalue=isovalue)
        # Between the last voxel of the background and the first of the tile.
        np.testing.assert_allclose(hits.t, 29.0 + 0.25, atol=1e-12)
        # The same border from within the tile.
        start[0, axis] = border + 30.0
        back = both_ways(monkeypatch, grid.volume, start, -toward, isovalue=isovalue)
        np.testing.assert_allclose(back.t, 30.75, atol=1e-12)

    def test_vectors_are_refused(self):
        with pytest.raises(UnsupportedGridError, match="vec3f"):
            raycast(TypedGrid("vec3f").volume, np.zeros((1, 3)), np.ones((1, 3)), device="cpu")


class TestRays:
    @pytest.mark.slow
    @pytest.mark.parametrize("axis", [0, 1, 2])
    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_along_the_borders_of_cells_and_leaves(self, rough, axis, sign, monkeypatch):
        lower = rough.lower.astype(float)
        start = np.stack(np.meshgrid(*[np.arange(0.0, 17.0, 8.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + lower
        start[::3] += 0.5
        toward = np.tile(sign * np.eye(3)[axis], (len(start), 1))
        hits = both_ways(monkeypatch, rough.volume, start, toward)
        assert_first_crossings(rough.at, start, toward, hits.t)
        assert np.isfinite(hits.t).sum() > 15

    def test_through_corners_of_leaves(self, rough, monkeypatch):
        signs = np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0
        corner = rough.lower + 8.0
        start = np.concatenate([corner - 20.0 * signs, corner - 20.0 * signs * [1, 1, 0], corner - 5.0 * signs])
        toward = np.concatenate([signs, signs * [1, 1, 0], signs])
        hits = both_ways(monkeypatch, rough.volume, start, toward)
        assert_first_crossings(rough.at, start, toward, hits.t)

    def test_start_on_a_level(self):
        # The plane x = 4 is the level; rays start on it.
        field = Field(np.broadcast_to(np.arange(8.0)[:, None, None] - 4.0, (8, 8, 8)), background=9.0)
        start = np.array([[4.0, 3.5, 3.5]] * 3)
        toward = np.array([[1.0, 0.1, 0.0], [-1.0, 0.0, 0.2], [0.0, 1.0, 0.0]])
        hits = raycast(field.volume, start, toward, device="cpu")
        np.testing.assert_array_equal(hits.t, 0.0)
        np.testing.assert_allclose(hits.normals, [[1.0, 0.0, 0.0]] * 3, atol=1e-15)
        past = raycast(field.volume, start, toward, t_min=1e-9, device="cpu")
        # Towards smaller x the background is above the level again, between x = 0 (-4) and x = -1 (9).
        np.testing.assert_allclose(past.t[:2], [np.inf, 4.0 + 4.0 / 13.0], rtol=1e-12)
        assert past.t[2] == 1e-9

    def test_touching_exactly(self):
        # |x - 4| has its least value, the level, at a plane of voxels.
        field = Field(np.broadcast_to(np.abs(np.arange(8.0) - 4.0)[:, None, None], (8, 8, 8)), background=9.0)
        hits = raycast(field.volume, [[0.0, 3.25, 3.5]], [[1.0, 0.0, 0.0]], device="cpu")
        np.testing.assert_array_equal(hits.t, [4.0])

    def test_a_level_equal_to_the_background_is_met_at_once(self):
        field = Field(np.full((8, 8, 8), 2.0), background=1.0)
        hits = raycast(field.volume, [[-50.0, 3, 3]] * 2, [[1.0, 0, 0], [0, 1.0, 0]], isovalue=1.0, device="cpu")
        np.testing.assert_array_equal(hits.t, [0.0, 0.0])
        np.testing.assert_array_equal(hits.normals, np.zeros((2, 3)))
        # From within it is met where the background begins.
        inside = raycast(field.volume, [[3.0, 3, 3]], [[2.0, 0, 0]], isovalue=1.0, device="cpu")
        np.testing.assert_allclose(inside.t, [2.5], rtol=1e-15)

    def test_direction_scales_t_only(self):
        origins, directions = np.full((1, 3), -30.0), np.array([[1.0, 1.02, 0.97]])
        one = raycast(sphere(), origins, directions, device="cpu")
        for length in (1e-140, 3.0, 1e140):
            other = raycast(sphere(), origins, directions * length, device="cpu")
            np.testing.assert_allclose(other.t * length, one.t, rtol=1e-14)
            np.testing.assert_allclose(other.points, one.points, atol=1e-12)

    def test_reach(self):
        volume, origins, directions = sphere(), np.array([[-30.0, 0.0, 0.0]]), np.array([[2.0, 0.0, 0.0]])
        assert raycast(volume, origins, directions, device="cpu").t[0] == pytest.approx(10.0)
        assert raycast(volume, origins, directions, max_distance=20.001, device="cpu").t[0] == pytest.approx(10.0)
        missed = raycast(volume, origins, directions, max_distance=19.9, device="cpu")
        assert missed.t[0] == math.inf
        assert np.isnan(missed.points).all()
        assert np.isnan(missed.normals).all()
        assert raycast(volume, origins, directions, t_min=10.5, device="cpu").t[0] == pytest.approx(20.0)
        assert raycast(volume, origins, directions, t_min=20.5, device="cpu").t[0] == math.inf
        assert raycast(volume, origins, directions, t_min=5.0, max_distance=8.0, device="cpu").t[0] == math.inf

    @pytest.mark.parametrize("reach", [0.5, 3.0, 6.0, 11.0])
    def test_nothing_is_hit_beyond_the_reach(self, reach, monkeypatch):
        # Most rays end between two crossings in one block.
        volume = Field(np.random.default_rng(3).normal(size=(16, 16, 16))).volume
        start, toward = rays_through(np.zeros(3), np.full(3, 15.0), 400, seed=4)
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        hits = both_ways(monkeypatch, volume, start, toward, max_distance=reach)
        assert np.isfinite(hits.t).any()
        assert (hits.t[np.isfinite(hits.t)] <= reach * (1 + 1e-12)).all()


class TestSmallGrids:
    def test_empty_grid(self):
        empty = Field(np.zeros((8, 8, 8)), stored=np.zeros((1, 1, 1), bool)).volume
        hits = raycast(empty, [[0.0, 0, 0]], [[1.0, 0, 0]], device="cpu")
        assert hits.t[0] == math.inf
        assert raycast(empty, [[0.0, 0, 0]], [[1.0, 0, 0]], isovalue=1.0, t_min=3.0, device="cpu").t[0] == 3.0

    def test_one_voxel(self, monkeypatch):
        dense = np.full((8, 8, 8), 1.0)
        dense[7, 0, 7] = -30.0
        field = Field(dense, lower=(-8, 8, 0))
        start, toward = rays_through(np.array([-2.0, 7.0, 6.0]), np.array([0.0, 9.0, 8.0]), 40, 6)
        hits = both_ways(monkeypatch, field.volume, start, toward)
        assert_first_crossings(field.at, start, toward, hits.t)
        assert np.isfinite(hits.t).sum() > 5

    def test_voxels_that_are_none_hide_their_cells(self, monkeypatch):
        dense = np.broadcast_to(np.arange(8.0)[:, None, None] - 4.5, (8, 8, 8)).copy()
        dense[:, 3, 3] = np.nan
        field = Field(dense, background=9.0)
        start = np.array([[0.5, 3.5, 3.5], [0.5, 5.5, 5.5]])
        hits = both_ways(monkeypatch, field.volume, start, np.array([[1.0, 0, 0]] * 2))
        assert hits.t[1] == 4.0
        assert hits.t[0] != 4.0

    def test_no_rays(self):
        hits = raycast(sphere(), np.empty((0, 3)), np.empty((0, 3)), device="cpu")
        assert [array.shape for array in hits] == [(0,), (0, 3), (0, 3)]


class TestBlocks:
    def test_are_kept_for_a_few_levels(self, monkeypatch):
        monkeypatch.setattr(crossing_blocks, "BLOCKS_PER_RAY", 1 << 20)
        volume = sphere()
        origins, directions = np.full((1, 3), -30.0), np.ones((1, 3))
        for isovalue in range(crossing_blocks.REMEMBERED + 2):
            raycast(volume, origins, directions, isovalue=isovalue / 10, device="cpu")
        kept = crossing_blocks.known_blocks(volume)
        assert len(kept) == crossing_blocks.REMEMBERED
        before = list(kept.values())[-1]
        raycast(volume, origins, directions, isovalue=(crossing_blocks.REMEMBERED + 1) / 10, device="cpu")
        assert list(kept.values())[-1] is before

    def test_are_left_out_where_they_would_not_pay(self):
        volume = sphere(40.0)  # 13^3 blocks with their rim
        raycast(volume, np.full((10, 3), -30.0), np.ones((10, 3)), device="cpu")
        assert not crossing_blocks.known_blocks(volume)
        raycast(volume, np.full((20_000, 3), -30.0), np.ones((20_000, 3)), device="cpu")
        assert len(crossing_blocks.known_blocks(volume)) == 1

    def test_distances_ahead(self):
        # Few crossings, so that the largest distance that is told apart is reached as well.
        field = Field(np.where(np.random.default_rng(1).random((320, 24, 40)) < 2e-5, -1.0, 1.0))
        levels, device = [wp.float64(0.0)] * 2, wp.get_device("cpu")
        blocks = crossing_blocks.crossing_blocks(field.volume, levels, 1 << 20, device)
        shape = tuple(blocks.block_count)
        ahead = blocks.reach.numpy().reshape(8, *shape)
        rim = np.pad(np.zeros(np.array(shape) - 2, bool), 1, constant_values=True)
        busy = np.argwhere(ahead[0] == 0)
        assert 0 < len(busy) < 40
        for octant, distances in enumerate(ahead):
            sign = np.where([octant & 4, octant & 2, octant & 1], -1, 1)
            apart = (busy - np.argwhere(~rim)[:, None]) * sign
            farthest = np.where((apart >= 0).all(axis=2), apart.max(axis=2), int(FARTHEST)).min(axis=1)
            np.testing.assert_array_equal(distances[~rim], np.minimum(farthest, int(FARTHEST)))
            assert (distances[rim] == -1).all()
        # A GPU goes block by block, with the same numbers.
        distance, stride = np.where(rim, -1, np.where(ahead[0] == 0, 0, int(FARTHEST))), rim.size
        found = wp.array(distance.ravel(), dtype=wp.int8, device=device)
        for along in shape:
            stride //= along
            wider = wp.empty(2 * found.size, dtype=wp.int8, device=device)
            launcher.launch(spread_distance_kernel, wider.size, [rim.size, stride, along, found], [wider], device)
            found = wider
        np.testing.assert_array_equal(found.numpy(), ahead.ravel())


class TestGroups:
    """On a CPU rays go side by side, by blocks."""

    def test_neighbors_do_not_matter(self, rough, monkeypatch):
        monkeypatch.setattr(crossing_blocks, "BLOCKS_PER_RAY", 1 << 20)
        start, toward = rays_through(rough.lower - 1.0, rough.lower + rough.dense.shape, 37, 5)
        together = raycast(rough.volume, start, toward, device="cpu")
        assert 0 < np.isfinite(together.t).sum() < 37
        for n in range(37):
            alone = raycast(rough.volume, start[n : n + 1], toward[n : n + 1], device="cpu")
            for one, other in zip(alone, together, strict=True):
                np.testing.assert_array_equal(one[0], other[n])

    def test_values_near_the_largest_number(self, monkeypatch):
        grid = TypedGrid("double")
        buffer = aligned_buffer(len(grid.volume.nanovdb))
        buffer[:] = grid.volume.nanovdb
        for end in (0, grid.layout.leaf_size):
            voxels = buffer[len(buffer) - end - 4096 : len(buffer) - end].view(np.float64)
            voxels *= 2.0**1000 / 2.0 ** np.ceil(np.log2(np.abs(grid.leaves).max()))
        start = np.random.default_rng(6).uniform(0.5, 6.5, (200, 3))
        toward = np.full((200, 3), 3.5) - start
        hits = both_ways(monkeypatch, SparseVolume(buffer, info_of(buffer)), start, toward, max_distance=2.0)
        assert np.isfinite(hits.t).sum() > 50

    @pytest.mark.parametrize("row", [0, 17, 39])
    def test_one_bad_ray_refuses_all(self, row, monkeypatch):
        monkeypatch.setattr(crossing_blocks, "BLOCKS_PER_RAY", 1 << 20)
        origins, directions = np.full((40, 3), -30.0), np.ones((40, 3))
        origins[row, 1] = np.nan
        with pytest.raises(InputError, match=f"origins: row {row} is not finite"):
            raycast(sphere(), origins, directions, device="cpu")
        with pytest.raises(InputError, match=f"directions: row {row} is zero"):
            raycast(sphere(), directions, np.where(np.isnan(origins[:, 1:2]), 0.0, directions), device="cpu")


class TestContainers:
    def test_single_precision_and_warp_arrays(self):
        origins = np.full((3, 3), -30.0, np.float32)
        directions = np.ones((3, 3), np.float32)
        single = raycast(sphere(), origins, directions, device="cpu")
        assert [array.dtype for array in single] == [np.float32] * 3
        given = [wp.array(a, dtype=wp.vec3f, device="cpu") for a in (origins, directions)]
        found = raycast(sphere(), *given, device="cpu")
        assert isinstance(found.t, wp.array)
        assert found.points.dtype == wp.vec3f
        np.testing.assert_array_equal(found.t.numpy(), single.t)

    def test_inputs_are_left_alone(self):
        origins, directions = np.full((3, 3), -30.0), np.ones((3, 3))
        raycast(sphere(), origins, directions, device="cpu")
        np.testing.assert_array_equal(origins, -30.0)
        np.testing.assert_array_equal(directions, 1.0)


class TestErrors:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"origins": np.zeros((2, 2))}, "origins: shape"),
            ({"origins": [[0.0, 0, 0], [np.nan, 0, 0]]}, "origins: row 1 is not finite"),
            ({"directions": [[1.0, 0, 0], [np.inf, 0, 0]]}, "directions: row 1 is not finite"),
            ({"directions": [[1.0, 0, 0], [0.0, 0, 0]]}, "directions: row 1 is zero"),
            ({"directions": [[1.0, 0, 0]]}, "directions: 1 rows for 2 origins"),
            ({"isovalue": np.nan}, "isovalue"),
            ({"isovalue": np.inf}, "isovalue"),
            ({"isovalue": "high"}, "isovalue"),
            ({"t_min": -1.0}, "t_min"),
            ({"t_min": np.inf}, "t_min"),
            ({"max_distance": -1.0}, "max_distance"),
            ({"max_distance": np.nan}, "max_distance"),
            ({"device": "cuda:99"}, "device"),
        ],
    )
    def test_bad_arguments(self, change, message):
        arguments = {"origins": np.zeros((2, 3)), "directions": np.ones((2, 3)), "device": "cpu", **change}
        with pytest.raises(InputError, match=message):
            raycast(sphere(), **arguments)


@pytest.mark.slow
@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
@pytest.mark.parametrize("exponent", [512, 700, 1020, -400, -530, -900])
def test_crossings_do_not_depend_on_the_unit_of_the_values(exponent, monkeypatch):
    """Beyond 1e154, and below 1e-154, the squares of values cannot be held."""
    from tests.support.analytic_volumes import field

    count = 20_000
    rng = np.random.default_rng(3)
    values = rng.uniform(-0.2, 1.0, 64 * 512)
    origins = rng.normal(size=(count, 3))
    origins *= 20.0 / np.linalg.norm(origins, axis=1)[:, None]
    directions = rng.normal(size=(count, 3)) * 4.0 - origins

    def cast(power):
        held = np.ldexp(values, power)
        grid = field(lambda _: held, dtype=np.float64, background=float(np.ldexp(1.0, power)))
        return both_ways(monkeypatch, grid, origins, directions, isovalue=float(np.ldexp(0.1, power)))

    expected, found = cast(0), cast(exponent)
    assert np.isfinite(expected.t).sum() > count // 2
    np.testing.assert_array_equal(found.t, expected.t)
    np.testing.assert_allclose(found.normals, expected.normals, rtol=0.0, atol=1e-12)
