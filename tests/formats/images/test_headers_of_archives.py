"""Headers as archives and old machines have them: read as other readers do, or refused by name."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import geokit as gk
from geokit.errors import FileFormatError

SHAPE, AT = (7, 6, 5), (5, 1, 3)


def patched(path: Path, offset: int, kind: str, *values: Any) -> Path:
    content = bytearray(path.read_bytes())
    struct.pack_into(kind, content, offset, *values)
    path.write_bytes(content)
    return path


def placed(path: Path) -> np.ndarray:
    """Where the one voxel that is not 0 lies in the world."""
    volume = gk.volume.load(path, grid_type="float")
    voxels = gk.volume.active_voxels(volume)
    assert voxels.values.tolist() == [7.0]
    return volume.info.transform[:3, :3] @ voxels.coordinates[0] + volume.info.transform[:3, 3]


@pytest.fixture
def nifti(tmp_path: Path) -> Path:
    """By nibabel, with a qform alone: half a turn about x, and steps of 0.9, 1.3 and 2.5."""
    nibabel = pytest.importorskip("nibabel")
    values = np.zeros(SHAPE, np.int16)
    values[AT] = 7
    matrix = np.diag([0.9, -1.3, -2.5, 1.0])
    matrix[:3, 3] = 5, 6, 7
    header = nibabel.Nifti1Header()
    image = nibabel.Nifti1Image(values, matrix, header)
    image.set_qform(matrix, 1)
    image.set_sform(None, 0)
    nibabel.save(image, tmp_path / "a.nii")
    return tmp_path / "a.nii"


RIGHT = np.array([5 + 0.9 * AT[0], 6 - 1.3 * AT[1], 7 - 2.5 * AT[2]])


@pytest.mark.parametrize(
    ("offset", "kind", "values"),
    [
        (76, "<f", (0.0,)),  # the direction of z
        (256, "<fff", (1.0000002, 0.0, 0.0)),
        (256, "<fff", (1.000001, 0.0, 0.0)),
        (48, "<hhhh", (0, 0, 0, 0)),
        (108, "<f", (352.0,)),
    ],
)
def test_nifti_is_repaired(nifti: Path, offset: int, kind: str, values: tuple[float, ...]) -> None:
    np.testing.assert_allclose(placed(patched(nifti, offset, kind, *values)), RIGHT, atol=1e-5)


def test_a_fourth_size_of_nothing_is_one(nifti: Path) -> None:
    np.testing.assert_allclose(placed(patched(patched(nifti, 40, "<h", 4), 48, "<h", 0)), RIGHT, atol=1e-5)


@pytest.mark.parametrize("offset", [0.0, 8.0, 348.0, 351.0, -1.0, float("nan")])
def test_voxels_within_the_header_are_refused(nifti: Path, offset: float) -> None:
    with pytest.raises(
        FileFormatError, match=r"a\.nii: says that its voxels begin at byte .*, and its header ends at 352"
    ):
        gk.volume.load(patched(nifti, 108, "<f", offset))


def test_a_quaternion_that_is_none_is_refused(nifti: Path) -> None:
    with pytest.raises(FileFormatError, match=r"a\.nii"):
        gk.volume.load(patched(nifti, 256, "<fff", 1.5, 0.0, 0.0))


def slices(folder: Path, bare: set[int], syntax: str = "ImplicitVRLittleEndian") -> None:
    """Four slices by pydicom, some of them without preamble, DICM and file meta information."""
    pydicom = pytest.importorskip("pydicom")
    for number in range(4):
        one = pydicom.Dataset()
        one.SOPClassUID, one.SOPInstanceUID = "1.2.840.10008.5.1.4.1.1.2", f"1.2.3.{number}"
        one.SeriesInstanceUID, one.InstanceNumber = "1.2.3", number + 1
        one.SamplesPerPixel, one.PhotometricInterpretation, one.Rows, one.Columns = 1, "MONOCHROME2", 2, 3
        one.BitsAllocated, one.BitsStored, one.HighBit, one.PixelRepresentation = 16, 12, 11, 0
        one.PixelSpacing, one.SliceThickness = [1, 1], 2
        one.ImageOrientationPatient, one.ImagePositionPatient = [1, 0, 0, 0, 1, 0], [0, 0, 2.0 * number]
        order = ">u2" if syntax == "ExplicitVRBigEndian" else "<u2"
        one.PixelData = (np.arange(6) + 100 * number + 1).astype(order).tobytes()
        one["PixelData"].VR = "OW"
        uid = getattr(pydicom.uid, syntax)
        path = folder / f"{number}.dcm"
        if number in bare:
            how = {"implicit_vr": uid.is_implicit_VR, "little_endian": uid.is_little_endian}
            one.save_as(path, **how, enforce_file_format=False)
        else:
            one.file_meta = pydicom.dataset.FileMetaDataset()
            one.file_meta.TransferSyntaxUID = uid
            one.save_as(path, enforce_file_format=True)


@pytest.mark.parametrize("bare", [{0, 1, 2, 3}, {3}, {0}, {1, 2}])
@pytest.mark.parametrize("syntax", ["ImplicitVRLittleEndian", "ExplicitVRLittleEndian"])
def test_dicom_without_a_preamble(bare: set[int], syntax: str, tmp_path: Path) -> None:
    slices(tmp_path, bare, syntax)
    (tmp_path / "readme.txt").write_text("of the archive")
    volume = gk.volume.load(tmp_path, grid_type="float")
    assert volume.info.index_bounds.tolist() == [[0, 0, 0], [2, 1, 3]]
    values = gk.volume.to_dense(volume).values
    expected = np.arange(6).reshape(2, 3).T[..., None] + 100 * np.arange(4) + 1
    assert np.array_equal(values, expected)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("stamp", [True, False])
def test_mrc_of_bytes_in_either_order(order: str, stamp: bool, tmp_path: Path) -> None:
    values = np.zeros(SHAPE, np.int8)
    values[AT] = 7
    x, y, z = SHAPE
    head = struct.pack(f"{order}10i6f3i", x, y, z, 0, 0, 0, 0, x, y, z, 2.0 * x, 2.0 * y, 2.0 * z, 90, 90, 90, 1, 2, 3)
    head = head.ljust(208, b"\0") + b"MAP " + (b"\x44\x44" if order == "<" else b"\x11\x11") * stamp
    path = tmp_path / "a.mrc"
    path.write_bytes(head.ljust(1024, b"\0") + values.transpose(2, 1, 0).tobytes())
    np.testing.assert_allclose(placed(path), 2.0 * np.array(AT))


def test_an_array_lies_where_its_transform_says() -> None:
    matrix = np.array([[0.0, -2.0, 0.0, 3.0], [1.5, 0.0, 0.0, -7.0], [0.0, 0.0, 0.5, 1.0], [0.0, 0.0, 0.0, 1.0]])
    values = np.zeros((9, 9, 9), np.float32)
    values[5:8, 2:4, 6] = np.arange(1, 7).reshape(3, 2)
    volume = gk.volume.from_dense(values, transform=matrix)
    dense = gk.volume.to_dense(volume)
    assert dense.origin.tolist() == [5, 2, 6]
    again = gk.volume.from_dense(dense.values, transform=dense.array_transform)
    index = np.argwhere(values) @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.array_equal(again.sample(index, order=0), volume.sample(index, order=0))
    assert np.array_equal(again.sample(index, order=0), values[values > 0])
    mask = gk.volume.from_dense(dense.values == 4, transform=dense.array_transform)
    assert np.array_equal(np.asarray(mask.sample(index, order=0)) != 0, values[values > 0] == 4)
