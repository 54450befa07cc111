"""Units of axes, and files that have several volumes or no place: what other programs write by hand-made headers."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import geokit as gk

from .needed import need

pytestmark = pytest.mark.slow

VALUES = np.random.default_rng(2).random((4, 5, 6)).astype(np.float32)
BYTES = VALUES.tobytes("F")


def _matrix(*steps: float, origin: tuple[float, ...] = (0.0, 0.0, 0.0)) -> np.ndarray:
    matrix = np.diag([*steps, 1.0])
    matrix[:3, 3] = origin
    return matrix


def _zarr(path: Path, units: tuple[str, ...], version: str) -> None:
    need(".zarr")
    import zarr

    group = zarr.open_group(str(path), mode="w", zarr_format=2 if version == "0.4" else 3)
    more: Any = {"shards": (6, 5, 4)}
    if version == "0.4":
        more = {"chunk_key_encoding": {"name": "v2", "separator": "."}}
    array = group.create_array("0", shape=(6, 5, 4), chunks=(2, 5, 2), dtype="f4", fill_value=7.0, **more)
    array[:4] = np.ascontiguousarray(VALUES.T)[:4]
    axes = [{"name": name, "type": "space", "unit": unit} for name, unit in zip("zyx", units, strict=True)]
    moves = [{"type": "scale", "scale": [500, 0.25, 0.5]}, {"type": "translation", "translation": [1000, 2, 3]}]
    scale = {"version": version, "axes": axes, "datasets": [{"path": "0", "coordinateTransformations": moves}]}
    scale["coordinateTransformations"] = [{"type": "scale", "scale": [2, 2, 2]}]
    group.attrs.update({"multiscales": [scale]} if version == "0.4" else {"ome": {"multiscales": [scale]}})


@pytest.mark.parametrize("version", ["0.4", "0.5"])
def test_axes_of_a_zarr_in_several_units(tmp_path: Path, version: str) -> None:
    _zarr(tmp_path / "a.zarr", ("nanometer", "micrometer", "micrometer"), version)
    grid = gk.volume.load(tmp_path / "a.zarr")
    assert grid.info.metadata["geokit:unit"] == "um"
    np.testing.assert_allclose(grid.info.transform, _matrix(1, 0.5, 1, origin=(6, 4, 2)), rtol=1e-15)
    dense = gk.volume.to_dense(grid)
    assert dense.values.shape == (4, 5, 4)
    np.testing.assert_array_equal(dense.values, VALUES[:, :, :4])
    assert grid.info.background == 7.0
    _zarr(tmp_path / "b.zarr", ("inch", "inch", "inch"), version)
    with pytest.warns(UserWarning, match="its unit 'inch' is not known and left out"):
        assert "geokit:unit" not in gk.volume.load(tmp_path / "b.zarr").info.metadata
    _zarr(tmp_path / "c.zarr", ("inch", "micrometer", "micrometer"), version)
    with pytest.raises(gk.FileFormatError, match="axes in the units 'um', 'um', 'inch'; save them in one of"):
        gk.volume.load(tmp_path / "c.zarr")


@pytest.mark.parametrize(
    ("fields", "steps"),
    [
        ('space dimension: 3\nspace directions: (1,0,0) (0,1,0) (0,0,5)\nspace units: "mm" "mm" "um"', (1, 1, 5e-3)),
        ('spacings: 1 2 3\nunits: "mm" "mm" "mm"', (1, 2, 3)),
    ],
)
def test_axes_of_an_nrrd_in_several_units(tmp_path: Path, fields: str, steps: tuple[float, ...]) -> None:
    need(".nrrd")
    head = f"NRRD0004\ntype: float\ndimension: 3\nsizes: 4 5 6\nencoding: raw\nendian: little\n{fields}\n\n"
    (tmp_path / "a.nrrd").write_bytes(head.encode() + BYTES)
    grid = gk.volume.load(tmp_path / "a.nrrd")
    assert grid.info.metadata["geokit:unit"] == "mm"
    np.testing.assert_allclose(grid.info.transform, _matrix(*steps), rtol=1e-15)


def test_the_unit_of_meta_image(tmp_path: Path) -> None:
    head = "NDims = 3\nDistanceUnits = um\nElementSpacing = 1 2 3\nDimSize = 4 5 6\nElementType = MET_FLOAT\n"
    (tmp_path / "a.mha").write_bytes(f"{head}ElementDataFile = LOCAL\n".encode() + BYTES)
    grid = gk.volume.load(tmp_path / "a.mha")
    assert grid.info.metadata["geokit:unit"] == "um"
    np.testing.assert_array_equal(gk.volume.to_dense(grid).values, VALUES)


def test_a_nifti_without_a_place_begins_at_zero(tmp_path: Path) -> None:
    need(".nii")
    import nibabel

    header = nibabel.Nifti1Header()
    header.set_data_dtype("f4")
    header.set_data_shape(VALUES.shape)
    header["pixdim"][1:4], header["magic"], header["vox_offset"] = (2, 3, 4), b"n+1", 352
    (tmp_path / "a.nii").write_bytes(header.binaryblock + bytes(4) + BYTES)
    grid = gk.volume.load(tmp_path / "a.nii")
    np.testing.assert_array_equal(grid.info.transform, _matrix(2, 3, 4))
    assert "geokit:space" not in grid.info.metadata
    np.testing.assert_array_equal(gk.volume.to_dense(grid).values, VALUES)


def test_a_stack_of_volumes_of_mrc(tmp_path: Path) -> None:
    need(".mrc")
    header = bytearray(1024)
    struct.pack_into("<10i6f3i", header, 0, 4, 5, 6, 2, 0, 0, 0, 4, 5, 3, 8, 10, 6, 90, 90, 90, 1, 2, 3)
    struct.pack_into("<i", header, 88, 401)
    header[208:212] = b"MAP "
    (tmp_path / "a.mrc").write_bytes(bytes(header) + BYTES)
    grids = gk.volume.load_all(tmp_path / "a.mrc")
    assert list(grids) == ["0", "1"]
    for number, grid in enumerate(grids.values()):
        np.testing.assert_array_equal(gk.volume.to_dense(grid).values, VALUES[:, :, 3 * number :][:, :, :3])
        np.testing.assert_array_equal(grid.info.transform, _matrix(2, 2, 2))
    struct.pack_into("<i", header, 36, 4)
    (tmp_path / "a.mrc").write_bytes(bytes(header) + BYTES)
    with pytest.raises(gk.FileFormatError, match="has 6 sections in volumes of 4"):
        gk.volume.load(tmp_path / "a.mrc")


def test_axes_and_palettes_of_tiff(tmp_path: Path) -> None:
    need(".tif")
    import tifffile

    pages = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    sizes = {"PhysicalSizeX": 0.5, "PhysicalSizeXUnit": "µm", "PhysicalSizeY": 250, "PhysicalSizeYUnit": "nm"}
    facts = {"axes": "ZYX", **sizes, "PhysicalSizeZ": 2, "PhysicalSizeZUnit": "µm"}
    tifffile.imwrite(tmp_path / "a.ome.tif", pages, photometric="minisblack", metadata=facts)
    grid = gk.volume.load(tmp_path / "a.ome.tif")
    assert grid.info.metadata["geokit:unit"] == "um"
    np.testing.assert_allclose(grid.info.transform, _matrix(0.5, 0.25, 2), rtol=1e-15)
    colors = np.tile(np.arange(256, dtype=np.uint16) * 257, (3, 1))
    tifffile.imwrite(tmp_path / "b.tif", pages, photometric="palette", colormap=colors)
    with pytest.warns(UserWarning, match="its palette of colors is left out"):
        np.testing.assert_array_equal(
            gk.volume.to_dense(gk.volume.load(tmp_path / "b.tif")).values, pages.transpose(2, 1, 0)
        )
