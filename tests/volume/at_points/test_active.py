"""Active states of voxels and tiles, for every grid type."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.catalog.sphere_volumes import sphere, sphere_leaves
from benchmarks.catalog.typed_grids import VALUED, TypedGrid
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume.at_points.active import active_at
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import HEAD_SIZE, info_of, tree_header

TREE = 672


def with_states(grid_type: str, tiles: bool) -> tuple[SparseVolume, np.ndarray]:
    """A grid whose first leaf has random states, tiles of all levels active or not; and the states (8, 8, 8)."""
    grid = TypedGrid(grid_type)
    buffer, layout = grid.volume.nanovdb, grid.layout
    leaf, lower, upper, _ = (TREE + int(offset) for offset in tree_header(buffer)["node_offset"])
    states = np.random.default_rng(8).integers(0, 2, 512).astype(bool)
    buffer[leaf + 16 : leaf + 80] = np.packbits(states, bitorder="little")
    if grid_type == "mask":  # whose values are the states
        buffer[leaf + layout.leaf_size + 16 : leaf + layout.leaf_size + 80] = 255
    # Slot 1 of both first nodes is a tile; the root's tile is its second entry.
    buffer[lower + 32] |= 2 * tiles
    buffer[upper + 32] |= 2 * tiles
    buffer[HEAD_SIZE + layout.root_size + layout.root_tile_size + 16] = tiles
    return SparseVolume(buffer, info_of(buffer)), states.reshape(8, 8, 8)


@pytest.mark.parametrize("tiles", [False, True])
@pytest.mark.parametrize("grid_type", VALUED)
def test_every_type(grid_type, tiles):
    volume, states = with_states(grid_type, tiles)
    rng = np.random.default_rng(9)
    ijk = rng.integers(0, 8, (200, 3))
    found = active_at(volume, ijk + rng.uniform(-0.49, 0.49, ijk.shape), device="cpu")
    assert found.dtype == bool
    np.testing.assert_array_equal(found, states[tuple(ijk.T)])
    # The second leaf is full; then a tile of each level, a tile that nobody set, and nothing at all.
    places = [[-3, 3, 3], [3, 3, 11], [30, 60, 200], [5000, 3, 3], [3, 11, 3], [-5000, 3, 3]]
    found = active_at(volume, np.array(places, float), device="cpu")
    np.testing.assert_array_equal(found, [True, tiles, tiles, tiles, False, False])


def test_narrow_band_of_a_sphere():
    origins, _, masks = sphere_leaves(10.0)
    inside = {tuple(voxel) for origin, mask in zip(origins, masks, strict=True) for voxel in origin + _voxels()[mask]}
    ijk = np.array(list(np.ndindex(32, 32, 32))) - 16
    expected = [tuple(voxel) in inside for voxel in ijk]
    np.testing.assert_array_equal(active_at(sphere(10.0), ijk.astype(float), device="cpu"), expected)


def _voxels():
    return np.array(list(np.ndindex(8, 8, 8)))


def test_halves_round_up_and_far_points_are_inactive():
    volume, states = with_states("float", False)
    at = np.array([[2.5, 3.5, 4.5]])
    assert active_at(volume, at, device="cpu")[0] == states[3, 4, 5]
    far = np.array([[3e9, 0, 0], [0, -2147483649.0, 0], [0, 0, 1e300]])
    assert not active_at(volume, far, device="cpu").any()


def test_containers():
    import warp as wp

    volume, _ = with_states("float", False)
    points = np.random.default_rng(1).uniform(0, 7, (30, 3))
    assert active_at(volume, np.empty((0, 3)), device="cpu").shape == (0,)
    found = active_at(volume, wp.array(points, dtype=wp.vec3d, device="cpu"))
    assert isinstance(found, wp.array)
    np.testing.assert_array_equal(found.numpy(), active_at(volume, points, device="cpu"))
    np.testing.assert_array_equal(active_at(volume, points.astype(np.float32), device="cpu"), found.numpy())


def test_refusals():
    volume, _ = with_states("float", False)
    with pytest.raises(InputError, match="row 1"):
        active_at(volume, [[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]], device="cpu")
    with pytest.raises(InputError, match="points: shape"):
        active_at(volume, np.zeros((4, 2)), device="cpu")
    buffer = volume.nanovdb.copy()
    buffer[636] = 23
    points_grid = SparseVolume(buffer, dataclasses.replace(volume.info, grid_type="pointindex"))
    with pytest.raises(UnsupportedGridError, match="pointindex"):
        active_at(points_grid, np.zeros((1, 3)), device="cpu")
