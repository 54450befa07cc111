"""Labels, masks and other types on other voxels: each takes the value of the nearest, as it is stored."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.catalog.typed_grids import TypedGrid
from geokit import native
from geokit.core.memory import available_memory
from geokit.errors import DeviceMemoryError, InputError, UnsupportedGridError
from geokit.volume._csg import union
from geokit.volume._dense import from_dense, to_dense
from geokit.volume._io import save
from geokit.volume._resample import resample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.checksum import checksum_matches
from geokit.volume.nanovdb.header import grid_header, tree_header
from geokit.volume.tree.typed_tree import VALUE_TYPES
from tests.support.effort import spread
from tests.support.nanovdb_validate import VALIDATED, assert_validated, needs_validate
from tests.support.random_grids import LOW, METADATA, TRANSFORM, random_grid

INTERPOLATED = ("float", "double", "vec3f", "vec3d")
LABELS = [name for name in VALUE_TYPES if name not in INTERPOLATED]
ANGLE = 0.37
# Turned about z, stretched, and somewhere else: no voxel of it lies half way between two of the sources.
TURNED = np.array(
    [
        [0.31 * np.cos(ANGLE), -0.43 * np.sin(ANGLE), 0.0, 1.234],
        [0.31 * np.sin(ANGLE), 0.43 * np.cos(ANGLE), 0.0, 0.567],
        [0.0, 0.0, 0.77, -0.891],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def expected_of(grid, target, lower, shape):
    """Values and states of the target's voxels from ``lower`` on, from dense arrays alone."""
    voxels = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3) + lower
    world = voxels @ target[:3, :3].T + target[:3, 3]
    source = grid.volume.info.transform
    index = (world - source[:3, 3]) @ np.linalg.inv(source[:3, :3]).T
    at = np.floor(index + 0.5).astype(int) - LOW
    inside = ((at >= 0) & (at < grid.active.shape)).all(axis=1)
    values = np.empty((len(voxels), *grid.values.shape[3:]), grid.values.dtype)
    values[:] = np.asarray(grid.volume.info.background, grid.values.dtype)
    states = np.zeros(len(voxels), np.bool_)
    states[inside] = grid.active[tuple(at[inside].T)]
    values[states] = grid.values[tuple(at[states].T)]
    return values.reshape(*shape, *values.shape[1:]), states.reshape(shape)


# Finer, coarser and mirrored.
SCALED = np.diag([-0.9137, 0.3571, 0.5923, 1.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("grid_type", "target"),
    [*[(name, TURNED) for name in spread(LABELS, 7)], *[(name, SCALED) for name in ("int64", "mask")]],
)
def test_every_voxel_has_the_nearest_value(grid_type, target):
    grid = random_grid(grid_type, 1)
    before = grid.volume.nanovdb.copy()
    result = resample(grid.volume, transform=target, order=0, device="cpu")
    check_grid(result.nanovdb, "result")
    assert checksum_matches(result.nanovdb)
    lower, upper = result.info.index_bounds + np.array([[-2], [2]])
    shape = tuple(upper - lower + 1)
    values, states = expected_of(grid, target, lower, shape)
    assert 1000 < states.sum() == result.info.active_voxel_count
    dense = to_dense(result, bounds=[lower, upper], device="cpu").values
    np.testing.assert_array_equal(dense, values)
    assert dense.dtype == values.dtype
    box = np.argwhere(states)
    np.testing.assert_array_equal(result.info.index_bounds, [box.min(axis=0) + lower, box.max(axis=0) + lower])
    info, was = result.info, grid.volume.info
    assert (info.grid_type, info.grid_class, info.name) == (was.grid_type, was.grid_class, was.name)
    assert (info.background, info.metadata) == (was.background, METADATA)
    np.testing.assert_array_equal(info.transform, target)
    np.testing.assert_allclose(info.voxel_size, np.linalg.norm(target[:3, :3], axis=0))
    world = grid_header(result.nanovdb)["world_bbox"].reshape(2, 3)
    centers = box @ target[:3, :3].T + lower @ target[:3, :3].T + target[:3, 3]
    assert (world[0] <= centers.min(axis=0) + 1e-9).all()
    assert (world[1] >= centers.max(axis=0) - 1e-9).all()
    np.testing.assert_array_equal(grid.volume.nanovdb, before)


# An inverse in float64 makes less than half of half of these.
@pytest.mark.parametrize("voxel_size", [0.1, 1.0, 7e-6, 0.82, 1.27, 0.09])
def test_halves_go_up(voxel_size):
    """Every other voxel of half the size lies half way between two of the source."""
    labels = np.arange(1, 13**3 + 1).reshape(13, 13, 13)
    source = from_dense(labels, voxel_size=voxel_size, origin=(-6, -6, -6))
    fine = to_dense(resample(source, voxel_size=voxel_size / 2, order=0, device="cpu"), device="cpu")
    # -13 lies half way between -7 and -6 and goes up, as 13 does to 7, where nothing is.
    assert fine.origin.tolist() == [-13, -13, -13]
    expected = labels.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
    np.testing.assert_array_equal(fine.values, expected)


def test_coarser_voxels_take_every_other():
    labels = np.arange(16**3, dtype=np.uint32).reshape(16, 16, 16) + 1
    source = from_dense(labels, voxel_size=0.1, origin=(-8, -8, -8))
    coarse = to_dense(resample(source, voxel_size=0.2, order=0, device="cpu"), device="cpu")
    assert coarse.origin.tolist() == [-4, -4, -4]
    np.testing.assert_array_equal(coarse.values, labels[::2, ::2, ::2])


def test_integers_beyond_2_to_the_53_are_exact():
    labels = np.array([2**62 + 1, -(2**61) - 3, 2**53 + 1, 2**63 - 1], np.int64).reshape(1, 1, 4)
    source = from_dense(labels, voxel_size=1.0, background=-(2**62) - 1)
    result = resample(source, transform=np.diag([0.5, 0.5, 1.0, 1.0]), order=0, device="cpu")
    dense = to_dense(result, bounds=[[-1, -1, 0], [0, 0, 3]], device="cpu").values
    np.testing.assert_array_equal(dense, np.broadcast_to(labels, (2, 2, 4)))
    assert result.info.background == -(2**62) - 1
    outside = to_dense(result, bounds=[[5, 5, 5], [5, 5, 5]], device="cpu").values
    assert outside.item() == -(2**62) - 1


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", LABELS)
def test_the_same_voxels_stay(grid_type):
    grid = random_grid(grid_type, 2)
    result = resample(grid.volume, transform=TRANSFORM, order=0, device="cpu")
    values = grid.values.copy()
    values[~grid.active] = np.asarray(grid.volume.info.background, values.dtype)
    bounds = [[LOW] * 3, [LOW + n - 1 for n in grid.active.shape]]
    np.testing.assert_array_equal(to_dense(result, bounds=bounds, device="cpu").values, values)
    assert result.info.active_voxel_count == grid.active.sum()


def test_parts_do_not_matter(monkeypatch):
    grid = random_grid("int32", 3).volume
    whole = resample(grid, transform=TURNED, order=0, device="cpu").nanovdb
    monkeypatch.setattr("geokit.volume.sampling.resample_leaves.LEAVES_AT_A_TIME", 7)
    np.testing.assert_array_equal(resample(grid, transform=TURNED, order=0, device="cpu").nanovdb, whole)


@pytest.mark.parametrize("grid_type", ["int64", "mask"])
def test_nothing_stays_nothing(grid_type):
    empty = from_dense(np.zeros((3, 3, 3), np.uint8), voxel_size=1.0, grid_type=grid_type)
    result = resample(empty, voxel_size=0.3, order=0, device="cpu")
    assert (result.info.active_voxel_count, result.info.index_bounds, result.info.grid_type) == (0, None, grid_type)
    assert tree_header(result.nanovdb)["node_count"].tolist() == [0, 0, 0]
    check_grid(result.nanovdb, "result")


def test_masks_of_different_voxels_can_be_combined():
    one = from_dense(np.ones((8, 8, 8), np.bool_), voxel_size=0.5, grid_type="mask")
    other = from_dense(np.ones((4, 4, 4), np.bool_), voxel_size=1.0, origin=(2, 0, 0), grid_type="mask")
    with pytest.raises(InputError, match="resample it with order=0"):
        union(one, other)
    both = union(one, resample(other, transform=one.info.transform, order=0, device="cpu"))
    # Voxels 3 .. 10 along x and -1 .. 6 along the others are nearest to those of the second.
    assert both.info.active_voxel_count == 512 + 512 - 5 * 7 * 7
    np.testing.assert_array_equal(both.info.index_bounds, [[0, -1, -1], [10, 7, 7]])


class TestRefusals:
    @pytest.mark.parametrize("order", [1, 2, 3])
    @pytest.mark.parametrize("grid_type", LABELS)
    def test_interpolation(self, grid_type, order):
        with pytest.raises(UnsupportedGridError, match=f"of type {grid_type}, .*use order=0"):
            resample(TypedGrid(grid_type).volume, voxel_size=0.5, order=order)

    def test_grids_without_values(self):
        source = random_grid("float", 0, tiles=False).volume
        other = SparseVolume(source.nanovdb, replace(source.info, grid_type="onindex"))
        for order in (0, 1):
            with pytest.raises(UnsupportedGridError, match="of type onindex; this operation takes"):
                resample(other, voxel_size=0.5, order=order)

    def test_options(self):
        labels = from_dense(np.ones((3, 3, 3), np.int32), voxel_size=1.0)
        far = np.eye(4)
        far[:3, 3] = 1e10
        for options, message in (
            ({}, "give one of the two"),
            ({"voxel_size": 0.0}, "voxel_size"),
            ({"transform": np.zeros((4, 4))}, "transform"),
            ({"transform": far}, "int32"),
            ({"transform": np.diag([1e-300, 1e-300, 1e-300, 1.0])}, "int32"),
            ({"voxel_size": 1.0, "order": 4}, "order"),
        ):
            with pytest.raises(InputError, match=message):
                resample(labels, **{"order": 0, **options})
        with pytest.raises(DeviceMemoryError, match="voxel_size: the result may need"):
            resample(labels, voxel_size=1e-6, order=0)
        large = from_dense(np.ones((3, 3, 3), np.int32), voxel_size=1e200)
        with pytest.raises(InputError, match="not comparable"):
            resample(large, voxel_size=1e-200, order=0)

    @pytest.mark.parametrize(("grid_type", "fits"), [("uint8", True), ("vec4d", False)])
    def test_memory_is_that_of_the_type(self, monkeypatch, grid_type, fits):
        values = np.ones((8, 8, 8) if fits else (8, 8, 8, 4), np.uint8)
        source = from_dense(values, voxel_size=1.0, grid_type=grid_type)
        # Eight leaves may hold a voxel of the result: 10 kB of bytes, 260 kB of four doubles each.
        monkeypatch.setattr(available_memory, "available_host", lambda: 40_000)
        if fits:
            assert resample(source, transform=np.eye(4), order=0, device="cpu").info.active_voxel_count == 512
        else:
            with pytest.raises(DeviceMemoryError):
                resample(source, transform=np.eye(4), order=0, device="cpu")


@pytest.mark.slow
@needs_validate
@pytest.mark.parametrize("grid_type", [name for name in VALIDATED if name not in INTERPOLATED])
def test_nanovdb_validate_accepts_results(tmp_path, grid_type):
    save(tmp_path / "x.nvdb", resample(random_grid(grid_type, 9).volume, transform=TURNED, order=0, device="cpu"))
    assert_validated(tmp_path / "x.nvdb")


@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
@pytest.mark.parametrize("grid_type", ["float", "double"])
def test_interpolated_types_take_the_nearest_too(grid_type):
    grid = random_grid(grid_type, 1)
    result = resample(grid.volume, transform=TURNED, order=0, device="cpu")
    lower, upper = result.info.index_bounds
    values, states = expected_of(grid, TURNED, lower, tuple(upper - lower + 1))
    assert states.sum() == result.info.active_voxel_count
    np.testing.assert_array_equal(to_dense(result, bounds=[lower, upper], device="cpu").values, values)
