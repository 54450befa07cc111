"""Staggered vector grids: each component is stored at the center of the voxel's lower face along its own axis."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.catalog.typed_grids import TypedGrid
from geokit import native
from geokit.volume.at_points.sample import gradient, sample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import aligned_buffer, grid_class_code, grid_header, info_of
from tests.support.reference import tensor_interpolant

SHEARED = np.array([[0.5, 0.2, 0.0, 3.0], [-0.1, 0.25, 0.3, -7.0], [0.0, 0.1, 2.0, 11.0], [0.0, 0.0, 0.0, 1.0]])
ORDERS = (0, 1, 2, 3)
# Some tens of roundings of values up to 200.
ROUNDING = 1e-11


def staggered(grid_type: str = "vec3f", transform: np.ndarray | None = None) -> TypedGrid:
    grid = TypedGrid(grid_type, transform)
    buffer = grid.volume.nanovdb
    grid_header(buffer)["grid_class"] = grid_class_code("staggered")
    grid.volume = SparseVolume(buffer, info_of(buffer))
    assert grid.volume.info.grid_class == "staggered"
    return grid


def cell_centered(grid: TypedGrid) -> SparseVolume:
    buffer = aligned_buffer(len(grid.volume.nanovdb))
    buffer[:] = grid.volume.nanovdb
    return SparseVolume(buffer, dataclasses.replace(grid.volume.info, grid_class="unknown"))


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(3)
    near = rng.uniform([-11, -3, -3], [11, 11, 19], (150, 3))
    return np.concatenate([near, rng.uniform([4093, -3, -3], [4099, 3, 3], (30, 3))])


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("grid_type", ["vec3f", "vec3d", "vec3u8", "vec3u16"])
def test_each_component_is_read_half_a_voxel_further_along_its_axis(grid_type, order, points):
    grid = staggered(grid_type)
    found = sample(grid.volume, points, order=order, device="cpu")
    for axis, step in enumerate(np.eye(3) / 2):
        at_centers = sample(cell_centered(grid), points + step, order=order, device="cpu")
        np.testing.assert_array_equal(found[:, axis], at_centers[:, axis])


@pytest.mark.parametrize("order", ORDERS)
def test_gradients(order, points):
    grid = staggered("vec3d", SHEARED)
    world = points @ SHEARED[:3, :3].T + SHEARED[:3, 3]
    found = gradient(grid.volume, world, order=order, device="cpu")
    assert found.shape == (len(points), 3, 3)
    for axis, step in enumerate(SHEARED[:3, :3].T / 2):
        at_centers = gradient(cell_centered(grid), world + step, order=order, device="cpu")
        # The half voxel is added to the world's coordinates here, to those of the index inside.
        np.testing.assert_allclose(found[:, axis], at_centers[:, axis], rtol=0, atol=1e-9)


@pytest.mark.parametrize("order", [2, 3])
def test_against_the_interpolant_in_numpy(order, points):
    grid = staggered("vec3f")
    found = sample(grid.volume, points, order=order, device="cpu")
    for axis, step in enumerate(np.eye(3) / 2):
        expected = tensor_interpolant(lambda ijk, axis=axis: grid.at(ijk)[:, axis], points + step, order)
        np.testing.assert_allclose(found[:, axis], expected, rtol=0, atol=ROUNDING)


def test_by_hand():
    # A leaf whose component c of voxel ijk is 100 c + ijk_c: the position of its face is that index less a half.
    grid = staggered("vec3f")
    buffer = grid.volume.nanovdb
    leaf = 672 + int(buffer[672:680].view("<u8")[0])  # the first of the tree's four offsets, counted from its header
    table = buffer[leaf + grid.layout.leaf_size - 512 * 12 :][: 512 * 12].view("<f4").reshape(8, 8, 8, 3)
    i, j, k = np.meshgrid(*3 * [np.arange(8.0)], indexing="ij")
    table[..., 0], table[..., 1], table[..., 2] = i, 100 + j, 200 + k
    # The lower face of voxel (3, 4, 5) along x holds its x component, and so on.
    for point, axis, value in (([2.5, 4, 5], 0, 3), ([3, 3.5, 5], 1, 104), ([3, 4, 4.5], 2, 205)):
        for order in ORDERS:
            assert sample(grid.volume, [point], order=order, device="cpu")[0, axis] == value
    # Half way between two faces the field is half way between their values, a cell's center here.
    found = sample(grid.volume, [[3.0, 4.0, 4.0]], device="cpu")
    np.testing.assert_array_equal(found, [[3.5, 104.5, 204.5]])
    for order in (1, 2, 3):
        slopes = gradient(grid.volume, [[3.25, 4.125, 4.0]], order=order, device="cpu")
        np.testing.assert_allclose(slopes, [np.eye(3)], rtol=0, atol=1e-13)


def test_other_grids_of_that_class_are_read_at_voxel_centers(points):
    # Only vectors of three components have faces to be on.
    for grid_type in ("float", "vec4f"):
        grid = staggered(grid_type)
        found = sample(grid.volume, points, device="cpu")
        np.testing.assert_array_equal(found, sample(cell_centered(grid), points, device="cpu"))


@pytest.mark.parametrize("order", ORDERS)
def test_containers_and_far_points(order):
    import warp as wp

    grid = staggered("vec3f")
    assert sample(grid.volume, np.empty((0, 3)), order=order, device="cpu").shape == (0, 3)
    single = sample(grid.volume, np.array([[1.0, 2.0, 3.0]], np.float32), order=order, device="cpu")
    assert single.dtype == np.float32
    given = wp.array([[1.0, 2.0, 3.0]], dtype=wp.vec3d, device="cpu")
    np.testing.assert_array_equal(sample(grid.volume, given, order=order).numpy().astype(np.float32), single)
    far = sample(grid.volume, [[3e9, 0.0, 0.0]], order=order, device="cpu")
    np.testing.assert_array_equal(far, [grid.background])


@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
def test_the_class_survives_openvdb(tmp_path):
    grid = staggered("vec3f")
    native.write_vdb(tmp_path / "grid.vdb", [native.VdbGrid(grid.volume.nanovdb, {})])
    (read,) = native.read_vdb(tmp_path / "grid.vdb")
    assert info_of(read.nanovdb, read.metadata).grid_class == "staggered"
