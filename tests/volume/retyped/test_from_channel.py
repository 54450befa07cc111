"""Index grids: their channels as volumes, and what is refused before an index is followed."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from benchmarks.catalog.index_grids import IndexGrid
from benchmarks.catalog.sphere_volumes import sphere
from geokit.errors import FileFormatError, InputError, UnsupportedGridError
from geokit.volume import load, save
from geokit.volume.at_points.active import active_at
from geokit.volume.at_points.sample import gradient, sample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.header import BLIND_DATA, aligned_buffer, grid_header, info_of
from geokit.volume.nanovdb.layout import INDEX_LAYOUTS
from geokit.volume.nanovdb.types import CHANNEL_TYPES
from geokit.volume.retyped.from_channel import channel_names, from_channel
from tests.support.reference import tensor_interpolant

TYPES = list(INDEX_LAYOUTS)


@pytest.fixture(scope="module")
def voxels():
    rng = np.random.default_rng(3)
    inside = np.array(list(np.ndindex(16, 8, 8))) - [8, 0, 0]
    far = rng.integers([-20, -3, -3], [20, 12, 300], (300, 3))
    return np.concatenate([inside, far, rng.integers([4090, -3, -3], [4102, 9, 9], (100, 3))])


@pytest.mark.parametrize("statistics", [False, True])
@pytest.mark.parametrize("grid_type", TYPES)
class TestEveryIndexType:
    def test_every_voxel_and_tile_has_the_value_its_index_leads_to(self, grid_type, statistics, voxels):
        grid = IndexGrid(grid_type, [("density", "float"), ("velocity", "vec3f")], statistics)
        expected = grid.index_at(voxels)
        assert len(np.unique(expected)) > 400
        for channel, values in zip((0, "velocity"), grid.values, strict=True):
            found = sample(grid.volume, voxels.astype(float), order=0, channel=channel, device="cpu")
            np.testing.assert_array_equal(found, values[expected].astype(float))

    def test_active_states(self, grid_type, statistics, voxels):
        grid = IndexGrid(grid_type, [("density", "float")], statistics)
        found = active_at(grid.volume, voxels.astype(float), device="cpu")
        made = active_at(from_channel(grid.volume), voxels.astype(float), device="cpu")
        np.testing.assert_array_equal(found, made)
        inside = voxels[:1024]
        expected = grid.masks[(inside[:, 0] < 0).astype(int), (inside % 8) @ [64, 8, 1]]
        np.testing.assert_array_equal(found[:1024], expected)


@wp.kernel
def lookup_kernel(volume: wp.uint64, voxels: wp.array(dtype=wp.vec3i), out_index: wp.array(dtype=wp.int32)):
    i = wp.tid()
    v = voxels[i]
    out_index[i] = wp.volume_lookup_index(volume, v[0], v[1], v[2])


@pytest.mark.parametrize("grid_type", TYPES)
def test_warp_finds_the_same_indices_in_the_leaves(grid_type, voxels):
    # So that it is not one mistake that wrote these grids and reads them.
    grid = IndexGrid(grid_type, [("density", "float")])
    inside = voxels[:1024]
    out = wp.empty(len(inside), dtype=wp.int32, device="cpu")
    given = wp.array(inside, dtype=wp.vec3i, device="cpu")
    wp.launch(lookup_kernel, dim=len(inside), inputs=[grid.volume.id("cpu"), given], outputs=[out], device="cpu")
    np.testing.assert_array_equal(out.numpy() + 1, grid.index_at(inside))


@pytest.mark.parametrize("kind", CHANNEL_TYPES)
def test_every_type_of_channel(kind, voxels):
    grid = IndexGrid("onindex", [("values", kind)])
    made = from_channel(grid.volume)
    assert made.info.grid_type == kind
    assert made.info.name == "values"
    check_grid(made.nanovdb, "made")
    found = sample(made, voxels.astype(float), order=0, device="cpu")
    np.testing.assert_array_equal(found, grid.values[0][grid.index_at(voxels)].astype(float))


@pytest.mark.parametrize("order", [1, 2, 3])
def test_values_and_gradients_between_voxels(order):
    grid = IndexGrid("onindex", [("density", "double")])
    u = np.random.default_rng(5).uniform([-10, -2, -2], [10, 10, 18], (200, 3))
    found = sample(grid.volume, u, order=order, device="cpu")
    if order > 1:
        expected = tensor_interpolant(lambda ijk: grid.values[0][grid.index_at(ijk)], u, order)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)
    made = from_channel(grid.volume, "density")
    np.testing.assert_array_equal(found, sample(made, u, order=order, device="cpu"))
    slopes = gradient(grid.volume, u, order=order, channel="density", device="cpu")
    np.testing.assert_array_equal(slopes, gradient(made, u, order=order, device="cpu"))


def test_what_the_made_volume_says_about_itself():
    grid = IndexGrid("index", [("", "float"), ("density", "float")])
    made = from_channel(grid.volume)
    assert made.info.name == "indices"  # the channel has no name
    assert made.info.grid_class == "unknown"
    assert made.info.background == grid.values[0][0]
    assert made.info.active_voxel_count == grid.volume.info.active_voxel_count
    np.testing.assert_array_equal(made.info.index_bounds, grid.volume.info.index_bounds)
    assert from_channel(grid.volume, 0) is made
    assert from_channel(grid.volume, 1) is not made
    assert channel_names(grid.volume) == ["", "density"]
    assert channel_names(sphere(4.0)) == []


@pytest.mark.parametrize("codec", ["none", "zip"])
def test_files(codec, tmp_path, voxels):
    grid = IndexGrid("onindex", [("density", "float")])
    save(tmp_path / "grid.nvdb", grid.volume, codec=codec)
    again = load(tmp_path / "grid.nvdb")
    assert again.info.grid_type == "onindex"
    assert again.info.background is None
    found = sample(again, voxels.astype(float), order=0, device="cpu")
    np.testing.assert_array_equal(found, grid.values[0][grid.index_at(voxels)])


class TestRefusals:
    def test_a_channel_that_is_not_there(self):
        volume = IndexGrid("index", [("density", "float")]).volume
        for channel in (1, -1, "heat", 0.0, True):
            with pytest.raises(InputError, match=r"channel: .* use one of 0 \('density'\)"):
                from_channel(volume, channel)

    def test_a_grid_that_holds_its_own_values(self):
        for call in (lambda: from_channel(sphere(4.0)), lambda: sample(sphere(4.0), np.zeros((1, 3)), channel=0)):
            with pytest.raises(InputError, match="channel: float grids hold their values themselves"):
                call()

    def test_no_channel(self):
        volume = IndexGrid("onindex").volume
        with pytest.raises(UnsupportedGridError, match="of type onindex stores no values"):
            sample(volume, np.zeros((1, 3)), device="cpu")
        assert active_at(volume, np.zeros((1, 3)), device="cpu").shape == (1,)

    def test_a_type_that_no_grid_holds_as_plain_values(self):
        volume = IndexGrid("index", [("flags", "uint8")]).volume
        buffer = _copied(volume)
        entry = grid_header(buffer)["blind_offset"]
        buffer[int(entry) + 28] = 13  # fp4
        with pytest.raises(UnsupportedGridError, match="'flags' of type fp4"):
            from_channel(SparseVolume(buffer, volume.info))

    def test_an_old_version(self):
        volume = IndexGrid("index", [("density", "float")]).volume
        buffer = _copied(volume)
        grid_header(buffer)["version"] = 32 << 21 | 5 << 10
        with pytest.raises(UnsupportedGridError, match=r"index grid is of NanoVDB 32\.5\.0"):
            from_channel(SparseVolume(buffer, info_of(buffer)))


def _copied(volume):
    buffer = aligned_buffer(len(volume.nanovdb))
    buffer[:] = volume.nanovdb
    return buffer


def _words(buffer, at, dtype="<u8"):
    return buffer[at : at + 8].view(dtype)


def refused(buffer, volume, match):
    damaged = SparseVolume(buffer, volume.info)
    calls = (
        lambda: sample(damaged, np.zeros((1, 3)), device="cpu"),
        lambda: active_at(damaged, np.zeros((1, 3)), device="cpu"),
        lambda: damaged.on("cpu"),
        lambda: channel_names(damaged),
    )
    for call in calls:
        with pytest.raises(FileFormatError, match=match):
            call()


@pytest.mark.parametrize("grid_type", TYPES)
class TestDamage:
    """Every index of the grid, one at a time, is made to lead outside of its channels."""

    @pytest.fixture
    def grid(self, grid_type):
        return IndexGrid(grid_type, [("density", "float")], statistics=True)

    @pytest.mark.parametrize("excess", [0, 1, 2**63])
    def test_background_and_tiles(self, grid, excess):
        places, layout = grid.places(), grid.layout
        for at, what in (
            (places["root"] + layout.root_background, "the background's index"),
            (places["root"] + layout.root_size + layout.root_tile_size + 24, "a tile of the root has an index"),
            (places["upper"] + layout.upper_table + 8, "a tile has an index"),
            (places["lower"] + layout.lower_size + layout.lower_table + 8 * 77, "a tile has an index"),
        ):
            buffer = _copied(grid.volume)
            _words(buffer, at)[0] = grid.count + excess
            refused(buffer, grid.volume, what)

    @pytest.mark.parametrize("excess", [1, 2**40, 2**64 - 3000])
    def test_leaves(self, grid, excess):
        buffer = _copied(grid.volume)
        at = grid.places()["leaf"] + grid.layout.leaf_size + 80
        # The last index of the last leaf, its statistics included, is the channel's last.
        _words(buffer, at)[0] += np.uint64(excess)
        refused(buffer, grid.volume, "a leaf has indices")

    def test_a_channel_that_is_too_short(self, grid):
        buffer = _copied(grid.volume)
        at = grid.places()["blind"]
        entry = buffer[at : at + BLIND_DATA.itemsize].view(BLIND_DATA)[0]
        entry["value_count"] -= 1
        with pytest.raises(FileFormatError, match=f"a channel of {grid.count - 1} values"):
            from_channel(SparseVolume(buffer, grid.volume.info))

    def test_a_channel_outside_of_the_grid(self, grid):
        for field, value in (("value_count", 10**12), ("offset", 10**9), ("offset", -(10**9))):
            buffer = _copied(grid.volume)
            at = grid.places()["blind"]
            buffer[at : at + BLIND_DATA.itemsize].view(BLIND_DATA)[0][field] = value
            refused(buffer, grid.volume, "blind data lies outside")

    def test_nodes(self, grid):
        buffer = _copied(grid.volume)
        places, layout = grid.places(), grid.layout
        _words(buffer, places["lower"] + layout.lower_table, "<i8")[0] += 32
        refused(buffer, grid.volume, "an offset does not lead to a leaf node")


@pytest.mark.parametrize("grid_type", ["onindex", "onindexmask"])
def test_prefix_sums_and_masks(grid_type):
    grid = IndexGrid(grid_type, [("density", "float")], statistics=True)
    leaf = grid.places()["leaf"]
    for at, bit in ((88, 0), (88, 62), (16, 0)):
        buffer = _copied(grid.volume)
        _words(buffer, leaf + at)[0] ^= np.uint64(1 << bit)
        refused(buffer, grid.volume, "the prefix sums of a leaf")
    # The last word's voxels are in no prefix sum: with more of them the last leaf ends too late.
    buffer = _copied(grid.volume)
    _words(buffer, leaf + grid.layout.leaf_size + 72)[0] = np.uint64(2**64 - 1)
    refused(buffer, grid.volume, "a leaf has indices")


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", ["index", "onindex"])
def test_random_damage_is_refused_or_harmless(grid_type):
    grid = IndexGrid(grid_type, [("density", "float")], statistics=True)
    rng = np.random.default_rng(13)
    voxels = np.array(list(np.ndindex(16, 8, 8))) - [8.0, 0, 0]
    places, refused = grid.places(), 0
    for _ in range(150):
        buffer = _copied(grid.volume)
        # Heads, leaves and what is behind them; most of an inner node is empty.
        at = rng.choice([rng.integers(0, places["upper"]), rng.integers(places["leaf"], places["blind"] + 288)])
        buffer[at] ^= 1 << rng.integers(0, 8)
        try:
            sample(SparseVolume(buffer, grid.volume.info), voxels, device="cpu")
        except (FileFormatError, UnsupportedGridError):
            refused += 1
    assert 5 < refused < 150
