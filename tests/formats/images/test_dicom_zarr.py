"""Folders as volumes: DICOM series, held against ITK's reader, and zarr."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit.formats.file_content.references import set_default_folders
from geokit.formats.images import zarr_image
from geokit.volume.images import save
from tests.formats.images.test_places import INDICES, LPS, STRAIGHT, VALUES, assert_there, at, turned, volume_at, world

pydicom = pytest.importorskip("pydicom")
zarr = pytest.importorskip("zarr")

STORED = (VALUES * 3).astype(np.uint16)


def write_series(
    folder: Path, matrix: np.ndarray, series: str = "1.2.3", names: str = "s{}.dcm", **more: object
) -> None:
    """Slices of STORED, in files whose names and numbers are in no order."""
    folder.mkdir(exist_ok=True)
    spacing = np.linalg.norm(matrix[:3, :3], axis=0)
    for k in range(STORED.shape[2]):
        data = pydicom.Dataset()
        data.SOPClassUID, data.SOPInstanceUID = pydicom.uid.CTImageStorage, f"{series}.{k + 1}"
        data.SeriesInstanceUID, data.SeriesDescription, data.Modality = series, f"series {series}", "CT"
        data.Rows, data.Columns, data.SamplesPerPixel = STORED.shape[1], STORED.shape[0], 1
        data.PhotometricInterpretation = "MONOCHROME2"
        data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 12, 11, 0
        data.PixelSpacing = [f"{spacing[1]:.10g}", f"{spacing[0]:.10g}"]
        axes = matrix[:3, :2] / spacing[:2]
        data.ImageOrientationPatient = [f"{one:.12g}" for one in axes.T.ravel()]
        data.ImagePositionPatient = [f"{one:.12g}" for one in matrix[:3, 3] + k * matrix[:3, 2]]
        data.InstanceNumber = (k * 3) % 7
        data.RescaleSlope, data.RescaleIntercept = 1, -1024
        data.PixelData = STORED[:, :, k].T.tobytes()
        for name, value in more.items():
            setattr(data, name, value)
        data.file_meta = pydicom.dataset.FileMetaDataset()
        data.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
        data.file_meta.MediaStorageSOPClassUID = data.SOPClassUID
        data.file_meta.MediaStorageSOPInstanceUID = data.SOPInstanceUID
        data.save_as(folder / names.format((k * 5) % 7), enforce_file_format=True)


def test_a_series_lies_where_itk_has_it(tmp_path: Path) -> None:
    sitk = pytest.importorskip("SimpleITK")
    write_series(tmp_path / "ct", turned())
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(tmp_path / "ct")))
    image = reader.Execute()
    values = sitk.GetArrayFromImage(image).transpose(2, 1, 0)
    points = np.array([image.TransformIndexToPhysicalPoint(index) for index in INDICES.tolist()])
    assert_there(tmp_path / "ct", points, at(INDICES, values), 1e-4)
    (info,) = gk.volume.inspect(tmp_path / "ct")
    assert info.grid_type == "int16"
    assert info.name == "series 1.2.3"
    assert dict(info.metadata) == {"geokit:unit": "mm", "geokit:space": "LPS"}
    # In the patient it is the same place in RAS.
    gk.volume.save(tmp_path / "a.nii", gk.volume.load(tmp_path / "ct"))
    assert_there(tmp_path / "a.nii", points @ LPS, at(INDICES, values), 1e-4)


def test_padding_is_background_and_slopes_make_floats(tmp_path: Path) -> None:
    write_series(tmp_path / "ct", turned(), PixelPaddingValue=int(STORED[0, 0, 0]))
    volume = gk.volume.load(tmp_path / "ct")
    assert volume.info.background == int(STORED[0, 0, 0]) - 1024
    assert volume.info.active_voxel_count == STORED.size - 1
    write_series(tmp_path / "pet", turned(), RescaleSlope="0.25", RescaleIntercept="0")
    dense = gk.volume.to_dense(gk.volume.load(tmp_path / "pet", background=-1), device="cpu")
    np.testing.assert_array_equal(dense.values, STORED * np.float32(0.25))


def test_several_series_are_grids_and_other_files_do_not_matter(tmp_path: Path) -> None:
    write_series(tmp_path / "ct", turned(), "1.2.3", "a{}")
    write_series(tmp_path / "ct", turned(), "1.2.4", "b{}")
    (tmp_path / "ct" / "notes.txt").write_text("nothing of the kind")
    assert sorted(gk.volume.load_all(tmp_path / "ct")) == ["series 1.2.3", "series 1.2.4"]
    with pytest.raises(gk.InputError, match="has 2 grids"):
        gk.volume.load(tmp_path / "ct")


@pytest.mark.parametrize(("thickness", "expected"), [("2.5", 2.5), ("0", 1.0), (None, 1.0)])
def test_one_slice_is_as_thick_as_it_says(tmp_path: Path, thickness: str | None, expected: float) -> None:
    write_series(tmp_path / "ct", STRAIGHT, SliceThickness=thickness)
    one = gk.volume.load(tmp_path / "ct" / "s0.dcm").info
    np.testing.assert_allclose(one.voxel_size, [*np.linalg.norm(STRAIGHT[:3, :2], axis=0), expected], rtol=1e-6)
    # That of several is their distance.
    several = gk.volume.load(tmp_path / "ct").info.voxel_size
    np.testing.assert_allclose(several, np.linalg.norm(STRAIGHT[:3, :3], axis=0), rtol=1e-6)


def test_a_missing_slice_is_named(tmp_path: Path) -> None:
    write_series(tmp_path / "ct", STRAIGHT)
    (tmp_path / "ct" / "s5.dcm").unlink()
    with pytest.raises(gk.FileFormatError, match=r"ct: slices lie 2\.3 to 4\.6 mm apart; one is missing"):
        gk.volume.load(tmp_path / "ct")


def test_what_is_no_series_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(gk.FileFormatError, match="empty: holds no DICOM images"):
        gk.volume.load(tmp_path / "empty")
    write_series(tmp_path / "ct", STRAIGHT)
    path = tmp_path / "ct" / "s0.dcm"
    data = pydicom.dcmread(path)
    data.file_meta.TransferSyntaxUID = pydicom.uid.JPEG2000Lossless
    data.PixelData = pydicom.encaps.encapsulate([bytes(64)])
    data["PixelData"].is_undefined_length = True
    data.save_as(path)
    with pytest.raises(gk.FileFormatError, match=r"s0\.dcm is compressed \(JPEG 2000.*decompress it first"):
        gk.volume.load(tmp_path / "ct")
    whole = pydicom.dcmread(tmp_path / "ct" / "s1.dcm")
    whole.file_meta.TransferSyntaxUID = pydicom.uid.DeflatedExplicitVRLittleEndian
    whole.save_as(path)
    with pytest.raises(gk.FileFormatError, match=r"s0\.dcm is compressed \(Deflated.*decompress it first"):
        gk.volume.load(tmp_path / "ct")
    write_series(tmp_path / "again", STRAIGHT)
    torn = (tmp_path / "again" / "s0.dcm").read_bytes()[:-40]
    (tmp_path / "again" / "s0.dcm").unlink()
    for name, kind in (("s0.dcm", r" as \.dcm"), ("IM0", "")):  # the slice is named, with an extension or without
        path = tmp_path / "again" / name
        path.write_bytes(torn)
        with pytest.raises(gk.FileFormatError, match=rf"again/{name}: cannot be read{kind} \(ValueError"):
            gk.volume.load(tmp_path / "again")
        path.unlink()


@pytest.mark.parametrize("element", [b"\x02\0\x01\0OB\0\0", b"\x08\0\x19\x01UC\0\0"], ids=["read", "skipped"])
def test_an_element_longer_than_its_file_is_named_before_memory_is_taken(tmp_path: Path, element: bytes) -> None:
    """Lengths of gigabytes, of what is read and of what is skipped, which would leave out the slice."""
    write_series(tmp_path / "ct", STRAIGHT, LongCodeValue="a code")
    path = tmp_path / "ct" / "s0.dcm"
    content = path.read_bytes()
    at = content.index(element) + len(element)
    path.write_bytes(content[:at] + (0xFFFFFFF0).to_bytes(4, "little") + content[at + 4 :])
    for named in (path, path.parent):
        with pytest.raises(gk.FileFormatError, match=r"ct/s0\.dcm: ends \d{10} bytes too early; get a whole copy"):
            gk.volume.load(named)


def test_pixels_of_an_old_file_longer_than_it_are_named(tmp_path: Path) -> None:
    write_series(tmp_path / "ct", STRAIGHT)
    content = (tmp_path / "ct" / "s0.dcm").read_bytes()
    at = content.index(b"\xe0\x7f\x10\0OW\0\0") + 8
    bare = content[content.index(b"\x08\0\x16\0") :]  # without a preamble, as it is read whole
    (tmp_path / "a.dcm").write_bytes(bare)
    assert gk.volume.load(tmp_path / "a.dcm").info.active_voxel_count > 10
    at -= len(content) - len(bare)
    (tmp_path / "a.dcm").write_bytes(bare[:at] + (0xFFFFFFF0).to_bytes(4, "little") + bare[at + 4 :])
    with pytest.raises(gk.FileFormatError, match=r"a\.dcm: ends \d{10} bytes too early; get a whole copy"):
        gk.volume.load(tmp_path / "a.dcm")


def test_a_file_meta_of_implicit_types_is_read(tmp_path: Path) -> None:
    write_series(tmp_path / "ct", STRAIGHT)
    content = (tmp_path / "ct" / "s0.dcm").read_bytes()
    elements = {b"\x02\0\x02\0": b"1.2.840.10008.5.1.4.1.1.2\0", b"\x02\0\x10\0": b"1.2.840.10008.1.2.1\0"}
    meta = b"".join(tag + len(value).to_bytes(4, "little") + value for tag, value in elements.items())
    (tmp_path / "a.dcm").write_bytes(bytes(128) + b"DICM" + meta + content[content.index(b"\x08\0\x16\0") :])
    with pytest.warns(UserWarning, match=r"a\.dcm: Expected explicit VR, but found implicit"):
        assert gk.volume.load(tmp_path / "a.dcm").info.active_voxel_count > 10


def test_values_by_a_table_or_a_palette_are_refused(tmp_path: Path) -> None:
    table = pydicom.Dataset()
    table.LUTDescriptor, table.ModalityLUTType, table.LUTData = [2, 0, 16], "HU", bytes(4)
    write_series(tmp_path / "lut", STRAIGHT, ModalityLUTSequence=pydicom.Sequence([table]))
    with pytest.raises(gk.FileFormatError, match=r"lut: s\d\.dcm has values by a table \(Modality LUT\)"):
        gk.volume.load(tmp_path / "lut")
    write_series(tmp_path / "palette", STRAIGHT, PhotometricInterpretation="PALETTE COLOR")
    with pytest.raises(gk.FileFormatError, match=r"palette: s\d\.dcm has colors by a palette"):
        gk.volume.load(tmp_path / "palette")


def test_frames_have_places_and_slopes_of_their_own(tmp_path: Path) -> None:
    """An enhanced file: signed pixels shown inverted, frames in no order on oblique planes."""
    turn = turned()
    write_series(tmp_path / "ct", turn)
    data = pydicom.dcmread(tmp_path / "ct" / "s0.dcm")
    order = [3, 0, 2, 1]
    shared, frames = pydicom.Dataset(), []
    plane, measures = pydicom.Dataset(), pydicom.Dataset()
    plane.ImageOrientationPatient, measures.PixelSpacing = data.ImageOrientationPatient, data.PixelSpacing
    measures.SliceThickness = "99"
    shared.PlaneOrientationSequence = pydicom.Sequence([plane])
    shared.PixelMeasuresSequence = pydicom.Sequence([measures])
    for k in order:
        frame, place, values = pydicom.Dataset(), pydicom.Dataset(), pydicom.Dataset()
        place.ImagePositionPatient = [f"{one:.12g}" for one in turn[:3, 3] + k * turn[:3, 2]]
        values.RescaleSlope, values.RescaleIntercept = f"{k + 1}", f"{-10 * k}"
        frame.PlanePositionSequence = pydicom.Sequence([place])
        frame.PixelValueTransformationSequence = pydicom.Sequence([values])
        frames.append(frame)
    for name in ("ImageOrientationPatient", "ImagePositionPatient", "PixelSpacing", "RescaleSlope", "RescaleIntercept"):
        delattr(data, name)
    data.SharedFunctionalGroupsSequence = pydicom.Sequence([shared])
    data.PerFrameFunctionalGroupsSequence = pydicom.Sequence(frames)
    data.NumberOfFrames, data.PixelRepresentation, data.PhotometricInterpretation = len(order), 1, "MONOCHROME1"
    data.BitsStored, data.HighBit = 16, 15
    signed = STORED[:, :, :4].astype(np.int16) - 700
    data.PixelData = np.stack([signed[:, :, k].T for k in order]).tobytes()
    data.save_as(tmp_path / "a.dcm")
    volume = gk.volume.load(tmp_path / "a.dcm", background=-1e9)
    expected = signed * np.arange(1.0, 5.0) - 10.0 * np.arange(4)
    np.testing.assert_allclose(gk.volume.to_dense(volume, device="cpu").values, expected, rtol=1e-6)
    np.testing.assert_allclose(volume.info.transform, turn, atol=1e-5)


@pytest.mark.parametrize("version", [2, 3])
def test_arrays_of_zarr(tmp_path: Path, version: int) -> None:
    array = zarr.create_array(str(tmp_path / "a.zarr"), data=VALUES, chunks=(2, 4, 4), zarr_format=version)
    assert_there(tmp_path / "a.zarr", INDICES.astype(float), at(INDICES, VALUES))
    assert array.chunks == (2, 4, 4)
    group = zarr.open_group(str(tmp_path / "b.zarr"), mode="w", zarr_format=version)
    for number, name in enumerate(("density", "heat")):
        group.create_array(name, data=VALUES * (number + 1), chunks=(2, 4, 4))
    dense = gk.volume.to_dense(gk.volume.load(tmp_path / "b.zarr", grid="heat"), device="cpu")
    np.testing.assert_array_equal(dense.values, VALUES * 2)


def test_an_ome_image_lies_where_it_says(tmp_path: Path) -> None:
    group = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=2)
    channels = np.stack([VALUES, 2 * VALUES]).transpose(0, 3, 2, 1)
    group.create_array("full", data=channels, chunks=(1, 4, 4, 4))
    moves = [
        {"type": "scale", "scale": [1.0, 2.3, 1.1, 0.7]},
        {"type": "translation", "translation": [0.0, 35.0, -20.0, 10.0]},
    ]
    axes = [{"name": "c", "type": "channel"}]
    axes += [{"name": axis, "type": "space", "unit": "micrometer"} for axis in "zyx"]
    datasets = [{"path": "full", "coordinateTransformations": moves}, {"path": "half"}]
    group.attrs["multiscales"] = [{"version": "0.4", "axes": axes, "datasets": datasets}]
    points = INDICES @ STRAIGHT[:3, :3].T + STRAIGHT[:3, 3]
    assert_there(tmp_path / "a.zarr", points, at(INDICES, 2 * VALUES), grid="1")
    assert gk.volume.inspect(tmp_path / "a.zarr")[0].metadata["geokit:unit"] == "um"


def test_zarr_finds_what_geokit_writes(tmp_path: Path) -> None:
    path = tmp_path / "a.zarr"
    gk.volume.save(path, volume_at(STRAIGHT, unit="mm"))
    gk.volume.save(path, volume_at(STRAIGHT, unit="mm"))  # replaced
    group = zarr.open_group(str(path), mode="r")
    np.testing.assert_array_equal(group["0"][:], VALUES.transpose(2, 1, 0))
    scale, move = group.attrs["multiscales"][0]["datasets"][0]["coordinateTransformations"]
    np.testing.assert_allclose(INDICES * scale["scale"][::-1] + move["translation"][::-1], world(STRAIGHT))
    assert group.attrs["multiscales"][0]["axes"][0]["unit"] == "millimeter"
    np.testing.assert_allclose(gk.volume.load(path).info.transform, STRAIGHT, atol=1e-12)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine.zarr").mkdir()
    with pytest.raises(gk.FileAccessError, match="exists and is no zarr folder"):
        gk.volume.save(tmp_path / "mine.zarr", volume_at(STRAIGHT))
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.zarr", "mine", "mine.zarr"]


def test_a_zarr_of_nothing_but_claims_is_refused(tmp_path: Path) -> None:
    zarr.create_array(str(tmp_path / "a.zarr"), shape=(100_000, 2000, 2000), chunks=(64, 64, 64), dtype="f4")
    with pytest.raises(gk.DeviceMemoryError, match=r"a\.zarr: its content needs .* GiB"):
        gk.volume.load(tmp_path / "a.zarr")


def _array(path: Path, **more: object) -> Path:
    """An array of zarr 2 with one chunk of 4^3 floats, which is not there."""
    path.mkdir(exist_ok=True)
    facts = {"zarr_format": 2, "shape": [4, 4, 4], "chunks": [4, 4, 4], "dtype": "<f4", "compressor": None}
    (path / ".zarray").write_text(json.dumps({**facts, "fill_value": 0, "order": "C", "filters": None, **more}))
    return path


def test_a_zarr_is_made_of_regular_files_in_its_folder(tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    path = _array(tmp_path / "here" / "a.zarr")
    chunk = path / "0.0.0"
    os.mkfifo(chunk)  # zarr would wait for someone who writes
    with pytest.raises(gk.FileAccessError, match=r"a\.zarr: refers to '0\.0\.0', which is not a regular file"):
        gk.volume.load(path)
    chunk.unlink()
    (tmp_path / "secret").write_bytes(np.arange(64, dtype="<f4").tobytes())
    chunk.symlink_to(tmp_path / "secret")
    with pytest.raises(gk.FileAccessError, match=r"'0\.0\.0' \(.*secret\), outside its own folder"):
        gk.volume.inspect(path)
    (tmp_path / "secret").rename(path / "inside")
    chunk.unlink()
    chunk.symlink_to("inside")
    assert gk.volume.load(path).info.active_voxel_count == 63


@pytest.mark.parametrize("kind", ["dicom", "zarr"])
def test_a_folder_of_the_caller_s_may_be_named_by_a_link(tmp_path: Path, kind: str) -> None:
    (tmp_path / "real").mkdir()
    folder = tmp_path / "real" / f"a.{kind}"
    if kind == "zarr":
        _array(folder)
        (folder / "inside").write_bytes(np.arange(64, dtype="<f4").tobytes())
        (folder / "0.0.0").symlink_to("inside")
    else:
        write_series(folder, STRAIGHT)
        (folder / "s0.dcm").rename(folder / "DICOMDIR")  # which is not read by that name
        (folder / "s0.dcm").symlink_to("DICOMDIR")
    (tmp_path / "named").mkdir()
    (tmp_path / "named" / f"link.{kind}").symlink_to(folder)
    assert gk.volume.load(tmp_path / "named" / f"link.{kind}").info.active_voxel_count > 60


def test_links_of_a_dicom_folder_lead_only_into_it_and_where_is_allowed(tmp_path: Path) -> None:
    folder = tmp_path / "here" / "ct"
    folder.parent.mkdir()
    write_series(folder, STRAIGHT)
    expected = gk.volume.load(folder).nanovdb.tobytes()
    (tmp_path / "elsewhere").mkdir()
    (folder / "s0.dcm").rename(tmp_path / "elsewhere" / "0.dcm")
    (folder / "s0.dcm").symlink_to(tmp_path / "elsewhere" / "0.dcm")
    for call in (gk.volume.load, gk.volume.inspect):
        with pytest.raises(gk.FileAccessError, match=r"ct: refers to 's0\.dcm' \(.*0\.dcm\), outside its own folder"):
            call(folder)
    set_default_folders([tmp_path / "elsewhere"])
    try:
        assert gk.volume.load(folder).nanovdb.tobytes() == expected
    finally:
        set_default_folders([])
    # The caller names a file by a link.
    (tmp_path / "a.dcm").symlink_to(folder / "s1.dcm")
    assert gk.volume.load(tmp_path / "a.dcm").info.active_voxel_count


def test_chunks_of_zarr_are_held_to_the_limit(tmp_path: Path) -> None:
    with pytest.raises(gk.DeviceMemoryError, match=r"its content needs 29.8 GiB of memory.*memory_limit"):
        gk.volume.load(_array(tmp_path / "a.zarr", chunks=[2000] * 3))
    with pytest.raises(gk.FileFormatError, match="chunks of"):
        gk.volume.load(_array(tmp_path / "a.zarr", chunks=[0] * 3))


def test_a_zarr_of_far_more_chunks_than_are_there_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for size in (300_000, 8_000_000):
        with pytest.raises(gk.FileFormatError, match=f"divided into {size} chunks .* or write it again"):
            gk.volume.load(_array(tmp_path / "a.zarr", shape=[size, 1, 1], chunks=[1, 1, 1]))
    values = np.arange(1.0, 127.0, dtype="f4").reshape(3, 6, 7)
    monkeypatch.setattr(zarr_image, "MOST_CHUNKS", 5)
    array = zarr.create_array(str(tmp_path / "b.zarr"), shape=values.shape, chunks=(2, 2, 2), dtype="f4")
    array[:] = values
    np.testing.assert_array_equal(gk.volume.to_dense(gk.volume.load(tmp_path / "b.zarr"), device="cpu").values, values)
    # Sparse ones have few of theirs.
    array = zarr.create_array(str(tmp_path / "c.zarr"), shape=values.shape, chunks=(2, 2, 2), dtype="f4")
    array[2, 5, 6] = 1.0
    assert gk.volume.load(tmp_path / "c.zarr").info.active_voxel_count == 1


def test_deflated_dicom_is_refused_before_it_is_decompressed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_series(tmp_path / "ct", turned())
    data = pydicom.dcmread(tmp_path / "ct" / "s0.dcm")
    data.file_meta.TransferSyntaxUID = pydicom.uid.DeflatedExplicitVRLittleEndian
    data.save_as(tmp_path / "a.dcm", enforce_file_format=True)
    monkeypatch.setattr(pydicom.filereader.zlib, "decompress", lambda *_: pytest.fail("it is decompressed"))
    content = (tmp_path / "a.dcm").read_bytes()
    for preamble in (content[:2], b"\x08\0"):
        (tmp_path / "a.dcm").write_bytes(preamble + content[2:])
        with pytest.raises(gk.FileFormatError, match=r"a\.dcm is compressed \(Deflated"):
            gk.volume.load(tmp_path / "a.dcm")


def test_a_folder_that_cannot_be_exchanged_in_one_step_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.zarr"
    old, new = (gk.volume.from_dense(VALUES * factor) for factor in (1.0, 2.0))
    gk.volume.save(path, old)
    monkeypatch.setattr(save, "_exchanged", lambda *_: False)
    replace = os.replace

    def interrupted(source: Path, target: Path) -> None:
        if target == path:
            monkeypatch.setattr(os, "replace", replace)
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        gk.volume.save(path, new)
    assert gk.volume.to_dense(gk.volume.load(path), device="cpu").values.max() == VALUES.max()
    gk.volume.save(path, new)
    assert gk.volume.to_dense(gk.volume.load(path), device="cpu").values.max() == 2 * VALUES.max()
    assert os.listdir(tmp_path) == ["a.zarr"]
