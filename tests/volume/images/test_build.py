"""Dense files become the same grids as arrays do, slab after slab; what is background is said."""

from __future__ import annotations

import dataclasses
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog.mesh_catalog import icosphere
from geokit import native
from geokit.formats.images import stream
from geokit.volume.images import build

RANDOM = np.random.default_rng(4)
BLOCK = np.zeros((45, 37, 29), np.float32)
BLOCK[5:33, 9:30, 3:25] = RANDOM.random((28, 21, 22)) + 1.0
DTYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "i8", "f2", "f4", "f8", "?", ">f4", ">i2")


def saved(path: Path, values: np.ndarray) -> Path:
    np.save(path, values)
    return path


@pytest.fixture(params=["whole", "slabs"])
def thickness(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "slabs":
        monkeypatch.setattr(stream, "SLAB_BYTES", 1)
        monkeypatch.setattr(build, "VOXELS_AT_A_TIME", 1)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.usefixtures("thickness")
def test_a_file_becomes_the_grid_of_its_array(tmp_path: Path, dtype: str, order: str) -> None:
    values = np.asarray((BLOCK * 40).astype(dtype), order=order)
    found, expected = gk.volume.load(saved(tmp_path / "a.npy", values)), gk.volume.from_dense(values)
    np.testing.assert_array_equal(found.nanovdb, expected.nanovdb)


@pytest.mark.usefixtures("thickness")
def test_vectors_tolerances_and_types(tmp_path: Path) -> None:
    vectors = np.stack([BLOCK, -BLOCK, BLOCK * 2], axis=-1)
    path = saved(tmp_path / "v.npy", vectors)
    np.testing.assert_array_equal(gk.volume.load(path).nanovdb, gk.volume.from_dense(vectors).nanovdb)
    path = saved(tmp_path / "a.npy", BLOCK)
    for how in ({"background": 1.25, "tolerance": 0.25}, {"grid_type": "double"}, {"grid_type": "float"}):
        expected = gk.volume.from_dense(BLOCK, **how)
        np.testing.assert_array_equal(gk.volume.load(path, **how).nanovdb, expected.nanovdb)
    assert gk.volume.load_all(path, tolerance=5.0)[""].info.active_voxel_count == 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", [".mha", ".vti"])
@pytest.mark.parametrize("grid_type", ["float", "double"])
@pytest.mark.usefixtures("thickness")
def test_a_level_set_keeps_class_background_and_inside(tmp_path: Path, kind: str, grid_type: str) -> None:
    ball = gk.volume.from_mesh(icosphere(3), voxel_size=0.04, device="cpu")
    if grid_type == "double":
        dense = gk.volume.to_dense(ball, device="cpu")
        options = {"background": float(ball.info.background), "grid_class": "level set", "grid_type": "double"}
        ball = gk.volume.from_dense(dense, **options)
    gk.volume.save(tmp_path / f"a{kind}", ball)
    again = gk.volume.load(tmp_path / f"a{kind}")
    for name in ("grid_class", "grid_type", "background", "active_voxel_count"):
        assert getattr(again.info, name) == getattr(ball.info, name)
    np.testing.assert_array_equal(again.info.index_bounds, ball.info.index_bounds)
    bounds = ball.info.index_bounds + np.array([[-20], [20]])
    found, expected = (gk.volume.to_dense(one, bounds=bounds, device="cpu").values for one in (again, ball))
    np.testing.assert_array_equal(found, expected)
    assert found[tuple(-bounds[0])] == -ball.info.background  # a tile deep inside


@pytest.mark.parametrize(
    ("edge", "background"), [(-1024, -1024), (0, 0), (7, 0)], ids=["air", "nothing", "a body that fills the array"]
)
def test_the_background_is_what_most_of_the_border_has_if_that_is_negative(
    tmp_path: Path, edge: int, background: int
) -> None:
    values = np.full((12, 13, 14), edge, np.int16)
    values[3:6, 4:7, 5:8] = 300
    info = gk.volume.load(saved(tmp_path / "a.npy", values)).info
    assert info.background == background
    assert info.active_voxel_count == (27 if edge == background else values.size)
    assert gk.volume.load(tmp_path / "a.npy", background=300).info.background == 300
    noise = RANDOM.integers(-1100, -900, values.shape).astype(np.int16)
    assert gk.volume.load(saved(tmp_path / "b.npy", noise)).info.background == 0


def test_values_that_are_not_finite_become_background_with_a_warning(tmp_path: Path) -> None:
    values = BLOCK.copy()
    values[7, 10, 4], values[8, 10, 4] = np.nan, np.inf
    with pytest.warns(UserWarning, match=r"a\.npy: 2 values are not finite and become the background"):
        volume = gk.volume.load(saved(tmp_path / "a.npy", values))
    values[7:9, 10, 4] = 0.0
    np.testing.assert_array_equal(volume.nanovdb, gk.volume.from_dense(values).nanovdb)


def test_what_no_grid_holds_is_an_error_of_the_file(tmp_path: Path) -> None:
    with pytest.raises(gk.FileFormatError, match=r"a\.npy: holds numbers beyond float32"):
        gk.volume.load(saved(tmp_path / "a.npy", np.full((3, 3, 4), 1e300)))
    with pytest.raises(gk.FileFormatError, match=r"b\.npy: .*int64 cannot hold"):
        gk.volume.load(saved(tmp_path / "b.npy", np.full((3, 3, 4), 2**63, np.uint64)))
    with pytest.raises(gk.FileFormatError, match=r"c\.npy: holds complex128"):
        gk.volume.load(saved(tmp_path / "c.npy", np.zeros((3, 3, 4), complex)))


def test_arguments_of_dense_files(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.npy", (BLOCK * 40).astype(np.uint8))
    with pytest.raises(gk.InputError, match=r"background: .* is no value of type uint8"):
        gk.volume.load(path, background=-1)
    with pytest.raises(gk.InputError, match="tolerance: -1"):
        gk.volume.load(path, tolerance=-1.0)
    with pytest.raises(gk.InputError, match="grid_type: 'nothing' is none that arrays are made of"):
        gk.volume.load(path, grid_type="nothing")
    with pytest.raises(gk.InputError, match="no grid named 'b'"):
        gk.volume.load(path, grid="b")
    gk.volume.save(tmp_path / "a.nvdb", gk.volume.load(path))
    for how in ({"background": 0.0}, {"tolerance": 0.5}, {"grid_type": "float"}):
        with pytest.raises(gk.InputError, match=r"has no effect on \.nvdb"):
            gk.volume.load_all(tmp_path / "a.nvdb", **how)
    with pytest.raises(gk.InputError, match=r"\.npy holds one volume, and 2 are given"):
        gk.volume.save(tmp_path / "b.npy", gk.volume.load(path), gk.volume.load(path))
    with pytest.raises(gk.InputError, match="half: "):
        gk.volume.save(tmp_path / "b.npy", gk.volume.load(path), half=True)
    with pytest.raises(gk.InputError, match="has no active voxel"):
        gk.volume.save(tmp_path / "b.npy", gk.volume.load(path, tolerance=255.0))
    assert not (tmp_path / "b.npy").exists()


def test_unit_and_space_go_through_sparse_files_and_operations(tmp_path: Path) -> None:
    volume = gk.volume.from_dense(BLOCK, voxel_size=0.5)
    known = {"geokit:unit": "mm", "geokit:space": "LPS"}
    volume = type(volume)(volume.nanovdb, dataclasses.replace(volume.info, metadata=known))
    gk.volume.save(tmp_path / "a.mha", volume)
    loaded = gk.volume.load(tmp_path / "a.mha")
    kinds = [".nvdb", ".vdb"] if native.available() else [".nvdb"]
    for kind in kinds:
        gk.volume.save(tmp_path / f"a{kind}", loaded)
        assert dict(gk.volume.load(tmp_path / f"a{kind}").info.metadata) == known
    assert dict(gk.volume.smooth(loaded).info.metadata) == known


@pytest.mark.skipif(not native.available(), reason="needs the OpenVDB extension")
@pytest.mark.parametrize("dtype", ["u1", "i2"])
def test_small_integers_are_int32_in_vdb(tmp_path: Path, dtype: str) -> None:
    values = (BLOCK * 40).astype(dtype)
    volume = gk.volume.from_dense(values, background=3, name="scan")
    gk.volume.save(tmp_path / "a.vdb", volume)
    again = gk.volume.load(tmp_path / "a.vdb")
    expected = gk.volume.from_dense(values, background=3, name="scan", grid_type="int32")
    assert (again.info.grid_type, again.info.name, again.info.background) == ("int32", "scan", 3)
    found, wanted = (gk.volume.to_dense(one, device="cpu").values for one in (again, expected))
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.slow
def test_the_dense_array_is_never_whole_in_memory(tmp_path: Path) -> None:
    """A file of 512 MiB with a small block takes less than a fifth of that; so does writing it."""
    values = np.lib.format.open_memmap(tmp_path / "a.npy", "w+", np.float32, (512, 512, 512))
    values[100:140, 200:240, 300:340] = 1.0
    values[500:505, 500:505, 500:505] = 2.0
    del values
    tracemalloc.start()
    try:
        volume = gk.volume.load(tmp_path / "a.npy")
        gk.volume.save(tmp_path / "b.mha", volume)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert volume.info.active_voxel_count == 64_125
    assert peak < 100 << 20
    assert gk.volume.load(tmp_path / "b.mha").info.active_voxel_count == 64_125
