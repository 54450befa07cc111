"""Dense arrays to sparse volumes and back: every type, every voxel, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from benchmarks.catalog.index_grids import IndexGrid
from benchmarks.catalog.sphere_volumes import ROTATED, lookup, sphere, sphere_distance
from benchmarks.catalog.typed_grids import VALUED, TypedGrid
from geokit.core.memory import available_memory
from geokit.errors import DeviceMemoryError, InputError, UnsupportedGridError
from geokit.volume._dense import from_dense, to_dense
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.checksum import checksum_matches
from geokit.volume.nanovdb.header import info_of, tree_header
from geokit.volume.nanovdb.nodes import grid_nodes


def box_indices(lower, upper) -> np.ndarray:
    axes = [np.arange(a, b + 1) for a, b in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


@pytest.mark.parametrize("grid_type", VALUED)
def test_every_type_is_read_as_it_is_stored(grid_type):
    grid = TypedGrid(grid_type)
    # Both leaves, their border, tiles of a lower and an upper node, and the background on two sides.
    bounds = [[-12, -2, -1], [9, 9, 131]]
    dense = to_dense(grid.volume, bounds=bounds, device="cpu")
    expected = grid.at(box_indices(*bounds).reshape(-1, 3)).reshape(*dense.values.shape)
    np.testing.assert_array_equal(dense.values.astype(np.float64), expected)
    kinds = {"bool": "?", "mask": "?", "half": "f2", "double": "f8", "vec3d": "f8", "vec4d": "f8", "rgba8": "u1"}
    kinds |= {name: name for name in ("int16", "int32", "int64", "uint8", "uint32")} | {"vec3u8": "u1", "vec3u16": "u2"}
    assert dense.values.dtype == np.dtype(kinds.get(grid_type, "f4"))
    assert dense.origin.tolist() == bounds[0]


def test_root_tiles_are_read_too():
    grid = TypedGrid("float")
    dense = to_dense(grid.volume, bounds=[[4094, 0, 0], [4098, 1, 9]], device="cpu")
    np.testing.assert_array_equal(
        dense.values, grid.at(box_indices((4094, 0, 0), (4098, 1, 9)).reshape(-1, 3)).reshape(5, 2, 10)
    )


def test_integers_beyond_2_to_the_53_are_exact():
    grid = TypedGrid("int64")
    values = np.array([2**62 + 1, -(2**61) - 3, 2**53 + 1], np.int64)
    begin = 672 + int(tree_header(grid.volume.nanovdb)["node_offset"][0])
    table = begin + grid.layout.leaf_size - 512 * 8
    grid.volume.nanovdb[table : table + 24] = values.view(np.uint8)
    tile = (
        672
        + int(tree_header(grid.volume.nanovdb)["node_offset"][1])
        + grid.layout.lower_table
        + 8 * (0 << 8 | 0 << 4 | 1)
    )
    grid.volume.nanovdb[tile : tile + 8] = values[:1].view(np.uint8)
    dense = to_dense(grid.volume, bounds=[[0, 0, 0], [0, 0, 8]], device="cpu").values[0, 0]
    assert dense[:3].tolist() == values.tolist()
    assert dense[8] == values[0]


def test_a_level_set_comes_back_bit_for_bit():
    volume = sphere(20.0, (3, -70, 4090), transform=ROTATED)
    dense = to_dense(volume, device="cpu")
    assert np.array_equal(dense.transform, ROTATED)
    voxels = box_indices(dense.origin, dense.origin + dense.values.shape - 1)
    expected = np.clip(sphere_distance(voxels, 20.0, (3, -70, 4090)), -3.0, 3.0)
    assert np.array_equal(dense.values, expected)
    again = from_dense(
        dense.values, origin=dense.origin, transform=ROTATED, background=3.0, name="again", grid_class="level set"
    )
    check_grid(again.nanovdb, "again")
    assert checksum_matches(again.nanovdb)
    assert (again.info.name, again.info.grid_class) == ("again", "level set")
    assert again.info.active_voxel_count == volume.info.active_voxel_count
    assert np.array_equal(again.info.index_bounds, volume.info.index_bounds)
    around = [dense.origin - 20, dense.origin + dense.values.shape + 20]
    assert np.array_equal(to_dense(again, bounds=around).values, to_dense(volume, bounds=around).values)
    # The inside is tiles: as few leaves as the band has.
    assert tree_header(again.nanovdb)["node_count"][0] == tree_header(volume.nanovdb)["node_count"][0]


@pytest.mark.parametrize("origin", [(0, 0, 0), (5, -3, 121), (-(2**31), 2**31 - 40, 0)])
def test_what_is_not_background_is_active(origin):
    rng = np.random.default_rng(1)
    values = np.where(rng.random((21, 17, 40)) < 0.02, rng.standard_normal((21, 17, 40)), 0.5)
    kept = values.copy()
    volume = from_dense(values, voxel_size=(0.1, 0.2, 0.3), origin=origin, background=0.5)
    assert np.array_equal(values, kept)
    assert volume.info.active_voxel_count == (values != 0.5).sum()
    assert np.array_equal(volume.info.transform, np.diag([0.1, 0.2, 0.3, 1.0]))
    voxels = np.argwhere(np.ones_like(values, bool))[::3] + np.array(origin)
    expected = values.reshape(-1)[::3].astype(np.float32)
    assert np.array_equal(lookup(volume.nanovdb, voxels), expected)


@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_boxes_and_extrema_are_those_of_the_active_voxels(dtype):
    rng = np.random.default_rng(4)
    kind = "float" if dtype is np.float32 else "int32"
    for share in (0.002, 0.1, 0.9, 1.0):
        values = rng.integers(-50, 50, (8, 8, 8)).astype(dtype)
        values[values == 0] = 1
        values[rng.random(values.shape) >= share] = 0
        grid = from_dense(values, voxel_size=1.0, grid_type=kind)
        if not values.any():
            continue
        where = np.argwhere(values)
        np.testing.assert_array_equal(grid.info.index_bounds, [where.min(axis=0), where.max(axis=0)])
        limits = grid_nodes(grid.nanovdb).leaf.limits[0]
        np.testing.assert_array_equal(limits, [values[values != 0].min(), values[values != 0].max()])


def test_extrema_of_zeros_are_the_first_zero():
    values = np.zeros((8, 8, 8), np.float32)
    values[3, 3, 3], values[5, 5, 5] = -0.0, -0.0
    leaf = grid_nodes(from_dense(values, voxel_size=1.0, background=1.0).nanovdb).leaf
    assert not np.signbit(leaf.limits).any()


def test_leaves_without_active_voxels_are_not_stored():
    values = np.zeros((64, 64, 64))
    values[9, 9, 9] = values[40, 63, 0] = 1.0
    volume = from_dense(values, voxel_size=1.0)
    assert tree_header(volume.nanovdb)["node_count"][0] == 2
    assert tree_header(from_dense(np.zeros((9, 9, 9)), voxel_size=1.0).nanovdb)["node_count"][0] == 0


def test_tolerance_takes_the_background_for_all_that_is_near():
    values = np.array([0.5, 0.5 + 0.09, 0.5 - 0.09, 0.62, 0.3]).reshape(1, 1, 5)
    volume = from_dense(values, voxel_size=1.0, background=0.5, tolerance=0.1)
    assert volume.info.active_voxel_count == 2
    dense = to_dense(volume, bounds=[[0, 0, 0], [0, 0, 4]]).values[0, 0]
    assert dense.tolist() == np.float32([0.5, 0.5, 0.5, 0.62, 0.3]).tolist()


def test_a_level_set_cut_by_the_array_keeps_its_inside_and_no_more():
    # A slab of inside that ends at the array: outside of the array there is nothing but background.
    values = np.full((300, 40, 44), -2.0)
    values[:, :, 40:] = 2.0
    values[150, 20, 12] = 0.5
    volume = from_dense(values, voxel_size=1.0, origin=(-7, 3, 5), background=2.0, grid_class="level set")
    bounds = np.array([[-16, -16, -16], [311, 63, 63]])
    dense = to_dense(volume, bounds=bounds).values
    expected = np.full(dense.shape, 2.0, np.float32)
    expected[9:309, 19:59, 21:65] = values
    assert np.array_equal(dense, expected)
    assert volume.info.active_voxel_count == 1
    # Leaves hold both signs, that of the active voxel too; lower nodes without any need one more to have tiles.
    tiles = expected.reshape(41, 8, 10, 8, 10, 8)
    below = (tiles < 0.0).sum(axis=(1, 3, 5))
    needed = int(((below > 0) & (below < 512)).sum())
    assert needed <= tree_header(volume.nanovdb)["node_count"][0] <= needed + 4


def test_level_set_inside_is_inactive():
    values = np.full((16, 16, 16), -1.0)
    values[4:6] = 0.25
    volume = from_dense(values, voxel_size=1.0, background=1.0, grid_class="level set")
    assert volume.info.active_voxel_count == 2 * 256
    assert from_dense(values, voxel_size=1.0, background=1.0).info.active_voxel_count == 16**3


@pytest.mark.parametrize("kind", ["list", "warp", "torch-like", "int", "bool", "fortran"])
def test_containers(kind):
    values = np.arange(24.0).reshape(2, 3, 4)
    given = {
        "list": values.tolist(),
        "warp": wp.array(values, dtype=wp.float64, device="cpu"),
        "torch-like": Exporter(values),
        "int": values.astype(np.int16),
        "bool": values > 3,
        "fortran": np.asfortranarray(values),
    }[kind]
    dense = to_dense(from_dense(given, voxel_size=1.0), bounds=[[0, 0, 0], [1, 2, 3]])
    assert np.array_equal(dense.values, values > 3 if kind == "bool" else values)


class Exporter:
    """What offers DLPack and nothing else, as arrays of other libraries do."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values

    def __dlpack__(self, **options):
        return self._values.__dlpack__()

    def __dlpack_device__(self):
        return self._values.__dlpack_device__()


def test_dtype_and_default_bounds():
    volume = from_dense(np.arange(8.0).reshape(2, 2, 2), voxel_size=1.0, origin=(1, 2, 3))
    dense = to_dense(volume, dtype=np.float64, device="cpu")
    assert dense.values.dtype == np.float64
    assert dense.origin.tolist() == [1, 2, 3]
    assert dense.values.shape == (2, 2, 2)
    assert to_dense(volume, dtype="f2").values.dtype == np.float16


def test_without_active_voxels_there_is_nothing():
    dense = to_dense(from_dense(np.zeros((3, 3, 3)), voxel_size=1.0))
    assert dense.values.shape == (0, 0, 0)
    assert to_dense(from_dense(np.zeros((0, 3, 3)), voxel_size=1.0), bounds=[[0, 0, 0], [1, 1, 1]]).values.sum() == 0.0


def test_blocks_do_not_matter(monkeypatch):
    volume = sphere(12.0)
    options = {"bounds": [[-20, -15, -15], [15, 20, 25]], "dtype": np.float64, "device": "cpu"}
    whole = to_dense(volume, **options).values
    made = from_dense(whole, voxel_size=1.0, origin=(3, 4, 5), background=3.0, grid_class="level set").nanovdb
    for size in (1, 41, 100, 30000):
        monkeypatch.setattr("geokit.volume._dense.VOXELS_AT_A_TIME", size)
        monkeypatch.setattr("geokit.volume.tree.dense_tiles.VOXELS_AT_A_TIME", size)
        assert np.array_equal(to_dense(volume, **options).values, whole)
        again = from_dense(whole, voxel_size=1.0, origin=(3, 4, 5), background=3.0, grid_class="level set").nanovdb
        assert np.array_equal(again, made)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"transform": np.eye(4), "voxel_size": 1.0}, "either a transform or a voxel_size"),
        ({"transform": np.eye(3)}, "transform: shape"),
        ({"transform": "x"}, "transform"),
        ({"voxel_size": 0.0}, "voxel_size"),
        ({"voxel_size": (1.0, 2.0)}, "voxel_size"),
        ({"voxel_size": 1.0, "origin": (0, 0)}, "origin"),
        ({"voxel_size": 1.0, "origin": (0.5, 0, 0)}, "origin"),
        ({"voxel_size": 1.0, "origin": (2**31 - 1, 0, 0)}, "origin"),
        ({"voxel_size": 1.0, "origin": (1e300, 0, 0)}, "origin"),
        ({"voxel_size": 1.0, "background": np.nan}, "background"),
        ({"voxel_size": 1.0, "tolerance": -1.0}, "tolerance"),
        ({"voxel_size": 1.0, "grid_class": "level set"}, "background"),
        ({"voxel_size": 1.0, "grid_class": "no class"}, "grid_class"),
        ({"voxel_size": 1.0, "name": "x" * 300}, "name"),
    ],
)
def test_from_dense_refuses(options, message):
    with pytest.raises(InputError, match=message):
        from_dense(np.ones((2, 2, 2)), **options)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.ones((2, 2)), "shape"),
        (np.ones((2, 2, 2), complex), "real number"),
        ([["a"]], "values"),
        (np.full((1, 2, 3), np.nan), r"voxel \[0, 0, 0\]"),
        (np.array([[[0.0, 1e300]]]), r"voxel \[0, 0, 1\]"),
    ],
)
def test_from_dense_refuses_values(values, message):
    with pytest.raises(InputError, match=message):
        from_dense(values, voxel_size=1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bounds": [0, 1]}, "bounds"),
        ({"bounds": [[0, 0, 0], [0, 0, 0.5]]}, "bounds"),
        ({"bounds": [[0, 0, 0], [0, 0, -1]]}, "bounds"),
        ({"bounds": [[0, 0, 0], [0, 0, 2**31]]}, "bounds"),
        ({"bounds": "x"}, "bounds"),
        ({"dtype": np.int32}, "dtype"),
        ({"dtype": complex}, "dtype"),
        ({"dtype": "no type"}, "dtype"),
        ({"device": "no device"}, "device"),
    ],
)
def test_to_dense_refuses(options, message):
    with pytest.raises(InputError, match=message):
        to_dense(sphere(4.0), **options)


def test_arrays_beyond_the_memory_are_refused(monkeypatch):
    with pytest.raises(DeviceMemoryError, match="MiB"):
        to_dense(sphere(4.0), bounds=[[-(2**31)] * 3, [2**31 - 1] * 3])
    monkeypatch.setattr(available_memory, "available_host", lambda: 1000)
    with pytest.raises(DeviceMemoryError, match="1 leaves"):
        from_dense(np.ones((2, 2, 2)), voxel_size=1.0)


def test_grids_without_values_are_refused():
    volume = TypedGrid("float").volume
    buffer = volume.nanovdb.copy()
    buffer[636:640] = np.array([23], "<u4").view(np.uint8)  # point indices
    with pytest.raises(UnsupportedGridError, match="pointindex"):
        to_dense(SparseVolume(buffer, info_of(buffer)))


@pytest.mark.parametrize("grid_type", ["index", "onindex"])
def test_channels_of_index_grids(grid_type):
    grid = IndexGrid(grid_type, [("density", "float"), ("velocity", "vec3f")])
    bounds = [[-9, -1, -1], [8, 8, 130]]
    expected = grid.index_at(box_indices(*bounds).reshape(-1, 3))
    for channel, values in zip((None, "velocity"), grid.values, strict=True):
        dense = to_dense(grid.volume, bounds=bounds, channel=channel, device="cpu").values
        np.testing.assert_array_equal(dense, values[expected].reshape(dense.shape))
    with pytest.raises(InputError, match="channel"):
        to_dense(grid.volume, channel="color")
    with pytest.raises(InputError, match="channel"):
        to_dense(sphere(4.0), channel=0)
    with pytest.raises(UnsupportedGridError, match="no channel"):
        to_dense(IndexGrid(grid_type).volume)
