"""Dense files that are cut, empty, of another format or refer to others: errors that begin with the path."""

from __future__ import annotations

import gzip
import pickle
import struct
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit.core.files import named_damage
from geokit.formats.table import SPARSE, STAGES, extensions, image_module
from tests.formats.images.needed import need
from tests.formats.images.test_places import STRAIGHT, VALUES, volume_at

WRITTEN = [kind for kind in extensions("volume", "w") if kind not in (*SPARSE, *STAGES, ".zarr")]


def written(folder: Path, kind: str, **options: object) -> Path:
    need(kind)
    volume = gk.volume.from_dense(VALUES) if kind == ".npy" else volume_at(STRAIGHT)
    gk.volume.save(folder / f"a{kind}", volume, **options)
    return folder / f"a{kind}"


@pytest.mark.parametrize("kind", WRITTEN)
def test_what_is_cut_is_refused_by_name(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path, kind)
    beside = path.with_suffix(".raw") if kind == ".mhd" else path
    data = beside.read_bytes()
    for size in (len(data) - 40, len(data) // 2, 20, 5):
        beside.write_bytes(data[:size])
        with pytest.raises(gk.FileFormatError) as error:
            gk.volume.load(path)
        assert str(error.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    "kind", [kind for kind in extensions("volume", "r") if kind not in (*SPARSE, *STAGES, ".zarr")]
)
def test_what_is_empty_or_something_else_is_refused_by_name(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a{kind}"
    for content, text in ((b"", "is empty"), (b"nothing of the kind = 1\n" * 90, "."), (bytes(2000), ".")):
        path.write_bytes(content)
        for read in (gk.volume.load, gk.volume.load_all, gk.volume.inspect):
            need(kind)
            with pytest.raises(gk.FileFormatError, match=text) as error:
                read(path)
            assert str(error.value).startswith(f"{path}: ")
    with pytest.raises(gk.FileAccessError, match="no such file"):
        gk.volume.load(tmp_path / f"none{kind}")


def test_an_empty_array_is_neither_a_volume_nor_a_cloud(tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(b"")
    with pytest.raises(gk.FileFormatError, match="is empty; get a whole copy"):
        image_module(".npy").is_volume(tmp_path / "a.npy")


@pytest.mark.parametrize("kind", [".nrrd", ".mha", ".nii.gz"])
def test_a_wrong_checksum_of_packed_data_is_found(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path, kind, codec="zip")
    data = bytearray(path.read_bytes())
    data[-2] ^= 1
    path.write_bytes(data)
    with pytest.raises(gk.FileFormatError, match="cannot be read"):
        gk.volume.load(path)


@pytest.mark.parametrize("kind", [".nhdr", ".mhd"])
def test_voxels_in_other_folders_are_refused(tmp_path: Path, kind: str) -> None:
    (tmp_path / "inside").mkdir()
    (tmp_path / "a.raw").write_bytes(bytes(8))
    path = tmp_path / "inside" / f"a{kind}"
    heads = {
        ".mhd": "NDims = 3\nDimSize = 2 2 2\nElementType = MET_UCHAR\nElementDataFile = {}\n",
        ".nhdr": "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\ndata file: {}\n\n",
    }
    need(kind)
    path.write_text(heads[kind].format("../a.raw"))
    with pytest.raises(gk.FileAccessError, match=r"refers to '\.\./a\.raw'.*outside its own folder"):
        gk.volume.load(path)
    path.write_text(heads[kind].format("none.raw"))
    with pytest.raises(gk.FileFormatError, match=r"refers to 'none\.raw', which is missing"):
        gk.volume.load(path)
    path.write_text(heads[kind].format("slice%03d.raw 1 9 1"))
    with pytest.raises(gk.FileFormatError, match="several files"):
        gk.volume.load(path)


def test_headers_without_a_place_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, ".mha")
    path.write_bytes(path.read_bytes().replace(b"ElementSpacing = 0.7 1.1 2.3", b"ElementSpacing = 0.0 1.1 2.3"))
    with pytest.raises(gk.FileFormatError, match=r"the transform of its voxels.*is not finite and invertible"):
        gk.volume.load(path)


def test_a_series_without_end_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, ".nii")
    data = bytearray(path.read_bytes())
    struct.pack_into("<8h", data, 40, 5, 5, 6, 7, 32000, 32000, 1, 1)
    path.write_bytes(data)
    with pytest.raises(gk.FileFormatError, match="no grid has 32000 float32 in a voxel"):
        gk.volume.load_all(path)


def test_a_packed_nifti_is_not_read_for_its_description(tmp_path: Path) -> None:
    path = written(tmp_path, ".nii.gz")
    data = gzip.decompress(path.read_bytes())
    path.write_bytes(gzip.compress(data[:-100]))
    assert gk.volume.inspect(path)[0].index_bounds.tolist() == [[3, -4, 5], [7, 1, 11]]
    with pytest.raises(gk.FileFormatError, match="ends 100 bytes too early"):
        gk.volume.load(path)


def test_another_file_s_voxels_are_not_replaced(tmp_path: Path) -> None:
    volume, beside = gk.volume.from_dense(VALUES, transform=STRAIGHT), tmp_path / "a.b.raw"
    beside.write_bytes(b"a camera's")
    for header in (None, b"ElementDataFile = other.raw\n", b"notes"):
        if header is not None:
            (tmp_path / "a.b.mhd").write_bytes(header)
        with pytest.raises(gk.FileAccessError, match=r"a\.b\.raw: is there, and the voxels of a\.b\.mhd would"):
            gk.volume.save(tmp_path / "a.b.mhd", volume)
        assert beside.read_bytes() == b"a camera's"
        assert header is None or (tmp_path / "a.b.mhd").read_bytes() == header
    beside.unlink()
    # Its own are, packed or not.
    for codec in ("none", "none", "zip", "zip", "none"):
        gk.volume.save(tmp_path / "a.b.mhd", volume, codec=codec)
        assert gk.volume.load(tmp_path / "a.b.mhd").info.active_voxel_count == volume.info.active_voxel_count


@pytest.mark.parametrize("kind", WRITTEN)
def test_names_types_and_backgrounds_come_back(tmp_path: Path, kind: str) -> None:
    """Of what the format itself does not hold, a note of geokit does."""
    need(kind)
    if kind == ".npy":
        pytest.skip("holds values only")
    volume = gk.volume.from_dense((VALUES % 3) > 1, transform=STRAIGHT, origin=(9, -9, 3), name='a "name"')
    gk.volume.save(tmp_path / f"a{kind}", volume)
    again = gk.volume.load(tmp_path / f"a{kind}")
    for name in ("name", "grid_type", "grid_class", "background", "active_voxel_count"):
        assert getattr(again.info, name) == getattr(volume.info, name)
    found, wanted = (gk.volume.to_dense(one, device="cpu") for one in (again, volume))
    np.testing.assert_array_equal(found.values, wanted.values)
    np.testing.assert_array_equal(found.origin, wanted.origin)


def test_what_a_message_quotes_is_cut(tmp_path: Path) -> None:
    """Headers of any length: the message keeps its begin, which names the file, and its end, which says what to do."""
    pytest.importorskip("nrrd")
    path = tmp_path / "a.nrrd"
    sizes = " ".join(["1"] * 100_000)
    path.write_text(f"NRRD0005\ntype: uint8\ndimension: 100000\nsizes: {sizes}\nencoding: raw\n\n")
    for call in (gk.volume.load, gk.volume.inspect):
        with pytest.raises(
            gk.FileFormatError, match=r"among sizes \[1, 1, .* \.\.\. .*; save x, y, z next to"
        ) as error:
            call(path)
        assert len(str(error.value)) < 2100 + len(str(path))
    with pytest.raises(gk.FileFormatError) as error, named_damage(path):
        raise gk.FileFormatError(f"{path}: is {'x' * 100_000}; {'correct it ' * 10}")
    assert str(error.value).startswith(f"{path}: is xxx")
    assert str(error.value).endswith("correct it")
    assert len(str(error.value)) < 2100 + len(str(path))


@pytest.mark.parametrize(
    ("matrix", "origin", "spacing"),
    [
        ("inf 0 0 0 1 0 0 0 1", "0 0 0", "1 1 1"),
        ("1 0 0 0 1 0 0 0 1", "0 nan 0", "1 1 1"),
        ("1 0 0 0 1 0 0 0 1", "0 0 inf", "inf 1 1"),
        ("1e308 1e308 0 0 1 0 0 0 1", "0 0 1e308", "1e308 1 1"),
    ],
)
def test_places_that_are_not_finite_are_refused_without_warnings(
    tmp_path: Path, matrix: str, origin: str, spacing: str
) -> None:
    path = tmp_path / "a.mha"
    path.write_bytes(
        f"NDims = 3\nTransformMatrix = {matrix}\nOffset = {origin}\nElementSpacing = {spacing}\nDimSize = 2 2 2\n"
        "ElementType = MET_UCHAR\nElementDataFile = LOCAL\n".encode()
        + bytes(range(8))
    )
    for call in (gk.volume.load, gk.volume.inspect):
        with pytest.raises(gk.FileFormatError, match=r"a\.mha: the transform of its voxels, .*, is not finite"):
            call(path)


def test_objects_of_python_are_refused_without_a_word_of_how_to_run_them(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    for content in (np.array([{}, None], object), None):
        np.save(path, content, allow_pickle=True) if content is not None else path.write_bytes(pickle.dumps([1, 2]))
        for call in (gk.volume.load, gk.points.load, gk.points.load_rays):
            with pytest.raises(gk.FileFormatError, match=r"a\.npy: .*or holds objects of Python") as error:
                call(path)
            assert "pickle" not in str(error.value)
    np.savez(tmp_path / "a.npz", points=np.array([{}, None], object))
    with pytest.raises(gk.FileFormatError, match=r"a\.npz: .*or holds objects of Python"):
        gk.points.load(tmp_path / "a.npz")
