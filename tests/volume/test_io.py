"""Loading and saving volumes by extension: names, choices, errors, and copies on devices."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

import geokit
from benchmarks.catalog.sphere_volumes import ROTATED, lookup, sphere
from geokit import native
from geokit.errors import (
    DeviceMemoryError,
    FileAccessError,
    FileFormatError,
    InputError,
    MissingDependencyError,
    UnsupportedGridError,
)
from geokit.volume import clip, inspect, load, load_all, resample, save
from geokit.volume._io import unique_names
from geokit.volume.model.sparse_volume import SparseVolume

FORMATS = (
    ".nvdb",
    pytest.param(".vdb", marks=pytest.mark.skipif(not native.available(), reason="built without OpenVDB")),
)
with_openvdb = pytest.mark.skipif(not native.available(), reason="built without OpenVDB")


def values_of(volume):
    rng = np.random.default_rng(0)
    return lookup(volume.nanovdb, rng.integers(-30, 30, (2000, 3)))


@pytest.mark.parametrize("kind", FORMATS)
def test_a_single_grid_needs_no_name(tmp_path, kind):
    volume = sphere(12.0, transform=ROTATED)
    save(tmp_path / f"x{kind}", volume)
    loaded = load(tmp_path / f"x{kind}")
    assert (loaded.info.name, loaded.info.grid_type, loaded.info.grid_class) == ("sphere", "float", "level set")
    assert np.array_equal(loaded.info.transform, ROTATED)
    assert loaded.info.background == 3.0
    assert loaded.info.active_voxel_count == volume.info.active_voxel_count
    assert np.array_equal(loaded.info.index_bounds, volume.info.index_bounds)
    assert np.array_equal(values_of(loaded), values_of(volume))
    assert not loaded.nanovdb.flags.writeable or kind == ".vdb"


@pytest.mark.slow
@pytest.mark.parametrize("kind", FORMATS)
def test_of_several_grids_one_is_chosen_by_name(tmp_path, kind):
    path = tmp_path / f"x{kind}"
    save(path, sphere(12.0, name="a"), sphere(6.0, name="b"))
    with pytest.raises(InputError, match="'a', 'b'"):
        load(path)
    with pytest.raises(InputError, match=r"no grid named 'c'.*'a', 'b'"):
        load(path, grid="c")
    assert np.array_equal(values_of(load(path, grid="b")), values_of(sphere(6.0)))
    assert {name: volume.info.name for name, volume in load_all(path).items()} == {"a": "a", "b": "b"}
    assert [info.name for info in inspect(path)] == ["a", "b"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", FORMATS)
def test_grids_of_one_name_are_numbered(tmp_path, kind):
    path = tmp_path / f"x{kind}"
    save(path, sphere(12.0, name="d"), sphere(6.0, name="d"), sphere(9.0, name="e"))
    found = load_all(path)
    assert list(found) == ["d", "d[1]", "e"]
    for name, radius in (("d", 12.0), ("d[1]", 6.0), ("e", 9.0)):
        assert np.array_equal(values_of(found[name]), values_of(sphere(radius)))
        assert np.array_equal(values_of(load(path, grid=name)), values_of(sphere(radius)))


def test_numbers_avoid_names_that_exist():
    assert unique_names(["d", "d", "d[1]", "d", ""]) == ["d", "d[2]", "d[1]", "d[3]", ""]


@pytest.mark.slow
@pytest.mark.parametrize("codec", [None, "none", "zip", "blosc"])
@pytest.mark.parametrize("kind", FORMATS)
def test_every_codec_comes_back(tmp_path, kind, codec):
    save(tmp_path / f"x{kind}", sphere(12.0), codec=codec)
    assert np.array_equal(values_of(load(tmp_path / f"x{kind}")), values_of(sphere(12.0)))


@with_openvdb
def test_openvdb_keeps_metadata_and_halves(tmp_path):
    volume = sphere(12.0)
    told = dataclasses.replace(volume, info=dataclasses.replace(volume.info, metadata={"creator": "test", "frame": 7}))
    save(tmp_path / "x.vdb", told, half=True)
    for loaded in (load(tmp_path / "x.vdb"), load(tmp_path / "x.vdb", trusted=True)):
        assert (loaded.info.metadata["creator"], loaded.info.metadata["frame"]) == ("test", 7)
        difference = np.abs(values_of(loaded) - values_of(volume)).max()
        assert 0.0 < difference < 3.0 * 2.0**-11
    again = tmp_path / "again.vdb"
    save(again, load(tmp_path / "x.vdb"))
    assert load(again).info.metadata["creator"] == "test"
    told = inspect(tmp_path / "x.vdb")[0]
    assert (told.name, told.grid_type, told.grid_class) == ("sphere", "float", "level set")
    assert told.active_voxel_count == volume.info.active_voxel_count


@pytest.fixture
def halves(tmp_path):
    """A .vdb file of two grids with 16 bits, and with metadata of its own."""
    told = {"geokit:file:creator": "Houdini", "geokit:file:frame": np.int32(7)}
    path = tmp_path / "halves.vdb"
    named = [dataclasses.replace(sphere(12.0).info, name=name, metadata=told) for name in ("density", "heat")]
    save(path, *(dataclasses.replace(sphere(12.0), info=info) for info in named), half=True)
    return path


@with_openvdb
@pytest.mark.parametrize("trusted", [False, True])
@pytest.mark.parametrize("way", [(".vdb",), (".nvdb", ".vdb")])
def test_a_copy_has_sixteen_bits_and_the_metadata_of_the_file(tmp_path, halves, way, trusted):
    read, path = load_all(halves, trusted=trusted), halves
    for kind in way:
        save(copy := tmp_path / f"copy{kind}", *load_all(path).values())
        path = copy
    found = load_all(path, trusted=trusted)
    assert list(found) == list(read)
    assert abs(path.stat().st_size - halves.stat().st_size) <= 0.03 * halves.stat().st_size
    told = {"geokit:file:creator": "Houdini", "geokit:file:frame": 7, "is_saved_as_half_float": True}
    for one, other in zip(read.values(), found.values(), strict=True):
        assert np.array_equal(one.nanovdb, other.nanovdb)
        assert one.info.metadata == other.info.metadata == told
    assert [info.metadata for info in inspect(path)] == [told, told]
    # One grid alone, and a part of it.
    save(path, clip(load(halves, grid="heat"), [[-8.0] * 3, [8.0] * 3]))
    assert load(path).info.metadata == told


@with_openvdb
def test_computed_values_are_not_rounded(tmp_path, halves):
    volume = load(halves)
    moved = resample(volume, voxel_size=0.8 * float(volume.info.voxel_size[0]), device="cpu")
    save(tmp_path / "moved.vdb", moved)
    found = load(tmp_path / "moved.vdb")
    assert np.array_equal(values_of(found), values_of(moved))
    assert found.info.metadata == {"geokit:file:creator": "Houdini", "geokit:file:frame": 7}
    save(tmp_path / "moved.vdb", moved, codec="none")
    save(tmp_path / "rounded.vdb", moved, codec="none", half=True)
    assert inspect(tmp_path / "rounded.vdb")[0].metadata == volume.info.metadata
    assert (tmp_path / "rounded.vdb").stat().st_size < 0.7 * (tmp_path / "moved.vdb").stat().st_size


def test_files_are_replaced_whole(tmp_path):
    path = tmp_path / "x.nvdb"
    save(path, sphere(12.0))
    before = path.read_bytes()
    with pytest.raises(InputError):
        save(path, dataclasses.replace(sphere(4.0), nanovdb=sphere(4.0).nanovdb[:800]))
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.nvdb"]
    save(path, sphere(4.0))
    assert np.array_equal(values_of(load(path)), values_of(sphere(4.0)))


@pytest.mark.parametrize("function", [load, load_all, inspect])
def test_files_that_cannot_be_loaded(tmp_path, function):
    with pytest.raises(InputError, match=r"'\.txt' is not a volume format"):
        function(tmp_path / "x.txt")
    with pytest.raises(FileAccessError, match="no such file"):
        function(tmp_path / "x.nvdb")
    (tmp_path / "x.nvdb").write_text("this is text")
    with pytest.raises(FileFormatError, match=r"x\.nvdb"):
        function(tmp_path / "x.nvdb")


@with_openvdb
@pytest.mark.parametrize("function", [load, load_all, inspect])
def test_text_called_vdb(tmp_path, function):
    (tmp_path / "x.vdb").write_text("this is text" * 100)
    with pytest.raises(FileFormatError, match=r"x\.vdb"):
        function(tmp_path / "x.vdb")


def test_what_cannot_be_saved(tmp_path):
    volume = sphere(4.0)
    with pytest.raises(InputError, match="volume format"):
        save(tmp_path / "x.obj", volume)
    with pytest.raises(InputError, match="no volumes"):
        save(tmp_path / "x.nvdb")
    with pytest.raises(InputError, match="codec"):
        save(tmp_path / "x.nvdb", volume, codec="gzip")
    with pytest.raises(InputError, match="half"):
        save(tmp_path / "x.nvdb", volume, half=True)
    with pytest.raises(InputError, match=r"volumes\[1\]: ndarray"):
        save(tmp_path / "x.nvdb", volume, volume.nanovdb)
    with pytest.raises(FileAccessError):
        save(tmp_path / "missing" / "x.nvdb", volume)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(native.available(), reason="built with OpenVDB")
def test_without_openvdb_the_packages_are_named(tmp_path):
    (tmp_path / "x.vdb").write_bytes(b"anything")
    for use in (load, load_all, inspect):
        with pytest.raises(MissingDependencyError, match="libopenvdb-dev"):
            use(tmp_path / "x.vdb")
    with pytest.raises(MissingDependencyError, match="libopenvdb-dev"):
        save(tmp_path / "y.vdb", sphere(4.0))


def test_a_volume_is_uploaded_once_and_shares_its_memory_on_the_cpu():
    volume = sphere(6.0)
    made = volume.on("cpu")
    assert volume.on("cpu") is made
    assert made.array().ptr == volume.nanovdb.ctypes.data
    assert volume.id("cpu") == int(made.id)


def test_unaligned_buffers_are_moved():
    source = sphere(6.0)
    memory = np.empty(len(source.nanovdb) + 65, np.uint8)
    start = -memory.ctypes.data % 32 + 1
    memory[start : start + len(source.nanovdb)] = source.nanovdb
    moved = SparseVolume(memory[start : start + len(source.nanovdb)], source.info)
    made = moved.on("cpu")
    assert made.array().ptr % 32 == 0
    assert np.array_equal(made.array().numpy(), source.nanovdb)


def test_uploading_checks_the_buffer_and_the_device():
    volume = sphere(6.0)
    with pytest.raises(InputError, match="device"):
        volume.on("cuda:99")
    with pytest.raises(FileFormatError, match="sphere"):
        SparseVolume(volume.nanovdb[:4096], volume.info).on("cpu")
    index_grid = volume.nanovdb.copy()
    index_grid[636] = 20
    with pytest.raises(UnsupportedGridError, match="onindex"):
        SparseVolume(index_grid, volume.info).on("cpu")


def test_a_device_without_room_is_named(monkeypatch):
    from geokit.volume.nanovdb import upload

    class FullDevice:
        alias, is_cuda, is_cpu, free_memory, is_mempool_enabled = "cuda:0", True, False, 1000, False

    monkeypatch.setattr(upload, "resolve_device", lambda device: FullDevice())
    with pytest.raises(DeviceMemoryError, match="1000 free bytes"):
        sphere(6.0).on("cuda:0")


def test_the_package_offers_its_names_without_warp():
    code = (
        "import sys, geokit, geokit.volume as v; assert set(v.__all__) <= set(dir(v)); "
        "v.load, v.save, v.inspect, v.GridInfo; "
        "assert not {'warp', 'trimesh', 'pyvista', 'scipy', 'blosc'} & set(sys.modules), sys.modules.keys(); "
        "assert callable(v.sample) and callable(v.gradient)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with pytest.raises(AttributeError, match="nothing"):
        _ = geokit.volume.nothing


def test_a_warp_volume_outlives_what_it_was_made_from(tmp_path):
    from geokit.volume import from_dense

    values = np.random.default_rng(0).normal(size=(40, 40, 40)).astype(np.float32)
    path = tmp_path / "field.nvdb"
    save(path, from_dense(values, voxel_size=1.0))
    kept = [load(path).on("cpu") for _ in range(20)]
    for volume in kept:
        assert len(volume.get_voxels()) == values.size


def test_two_volumes_of_one_buffer():
    first = sphere()
    second = SparseVolume(first.nanovdb, first.info)
    points = np.random.default_rng(0).uniform(-10, 10, (50, 3))
    np.testing.assert_array_equal(first.sample(points, device="cpu"), second.sample(points, device="cpu"))
