"""Where the voxels of dense files lie: other libraries say it, of files that they wrote and that geokit wrote.

Every array is different along its axes, and every voxel has a value of its own.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit.formats.images import stream
from geokit.formats.images.image import in_space

SHAPE = (5, 6, 7)
VALUES = np.random.default_rng(1).permutation(210).reshape(SHAPE).astype(np.float32) + 1.0
LPS = np.diag([-1.0, -1.0, 1.0])


def turned() -> np.ndarray:
    """Index to world with axes at right angles that are none of the world's, voxels of three lengths, right-handed."""
    axes, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes * [0.7, 1.1, 2.3], [10.0, -20.0, 35.0]
    return matrix


STRAIGHT = np.array([[0.7, 0, 0, 10], [0, 1.1, 0, -20], [0, 0, 2.3, 35], [0, 0, 0, 1.0]])
INDICES = np.argwhere(np.ones(SHAPE))


def assert_there(path: Path, points: np.ndarray, values: np.ndarray, atol: float = 1e-5, **how: object) -> None:
    """The volume has the values at the points, which are centers of voxels."""
    volume = gk.volume.load(path, **how)
    index = np.linalg.solve(volume.info.transform[:3, :3], (points - volume.info.transform[:3, 3]).T).T
    np.testing.assert_allclose(index, np.rint(index), atol=atol)
    np.testing.assert_array_equal(volume.sample(np.rint(index), order=0, space="index", device="cpu"), values)
    assert volume.info.active_voxel_count == len(values)


def volume_at(matrix: np.ndarray, **metadata: str) -> gk.volume.SparseVolume:
    volume = gk.volume.from_dense(VALUES, transform=matrix, origin=(3, -4, 5))
    return type(volume)(volume.nanovdb, _with(volume.info, metadata))


def _with(info: gk.volume.GridInfo, metadata: dict[str, str]) -> gk.volume.GridInfo:
    import dataclasses

    return dataclasses.replace(info, metadata={f"geokit:{name}": text for name, text in metadata.items()})


def world(matrix: np.ndarray) -> np.ndarray:
    return (INDICES + np.array([3, -4, 5])) @ matrix[:3, :3].T + matrix[:3, 3]


def at(indices: np.ndarray, values: np.ndarray) -> np.ndarray:
    return values[tuple(indices.T)]


# --- files of other libraries -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [".nii", ".nii.gz"])
@pytest.mark.parametrize("version", [1, 2])
def test_files_of_nibabel(tmp_path: Path, kind: str, version: int) -> None:
    nibabel = pytest.importorskip("nibabel")
    image = (nibabel.Nifti1Image if version == 1 else nibabel.Nifti2Image)(VALUES, turned())
    image.header.set_xyzt_units("mm")
    nibabel.save(image, tmp_path / f"a{kind}")
    points = nibabel.affines.apply_affine(image.affine, INDICES)
    assert_there(tmp_path / f"a{kind}", points, at(INDICES, VALUES), 1e-4)
    assert dict(gk.volume.load(tmp_path / f"a{kind}").info.metadata) == {"geokit:unit": "mm", "geokit:space": "RAS"}


def test_a_nifti_with_a_quaternion_a_slope_and_another_byte_order(tmp_path: Path) -> None:
    nibabel = pytest.importorskip("nibabel")
    header = nibabel.Nifti1Header(endianness=">")
    header.set_data_dtype(np.int16)
    image = nibabel.Nifti1Image((VALUES - 100).astype(np.int16), None, header)
    image.set_qform(turned(), 1)
    image.set_sform(None, 0)
    image.header.set_slope_inter(0.5, -3.0)
    nibabel.save(image, tmp_path / "a.nii")
    again = nibabel.load(tmp_path / "a.nii")
    volume = gk.volume.load(tmp_path / "a.nii", background=1e6)
    np.testing.assert_allclose(volume.info.transform, again.affine, atol=1e-5)
    dense = gk.volume.to_dense(volume, device="cpu")
    np.testing.assert_array_equal(dense.values, again.get_fdata().astype(np.float32))


def test_points_in_time_and_colors_of_nifti(tmp_path: Path) -> None:
    nibabel = pytest.importorskip("nibabel")
    series = np.stack([VALUES, 2 * VALUES, 3 * VALUES], axis=-1)
    nibabel.save(nibabel.Nifti1Image(series, turned()), tmp_path / "a.nii.gz")
    volumes = gk.volume.load_all(tmp_path / "a.nii.gz")
    assert list(volumes) == ["0", "1", "2"]
    for number, volume in enumerate(volumes.values()):
        np.testing.assert_array_equal(gk.volume.to_dense(volume, device="cpu").values, series[..., number])
    with pytest.raises(gk.InputError, match="has 3 grids"):
        gk.volume.load(tmp_path / "a.nii.gz")
    colors = np.zeros(SHAPE, np.dtype([("R", "u1"), ("G", "u1"), ("B", "u1")]))
    colors["R"], colors["B"] = VALUES, 7
    nibabel.save(nibabel.Nifti1Image(colors, np.eye(4)), tmp_path / "b.nii")
    volume = gk.volume.load(tmp_path / "b.nii")
    assert volume.info.grid_type == "vec3u8"
    np.testing.assert_array_equal(gk.volume.to_dense(volume, device="cpu").values[..., 0], VALUES)


@pytest.mark.parametrize("kind", [".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd", "zipped.mha", "zipped.mhd"])
def test_files_of_simpleitk(tmp_path: Path, kind: str) -> None:
    sitk = pytest.importorskip("SimpleITK")
    image = sitk.GetImageFromArray(VALUES.transpose(2, 1, 0))
    matrix = turned()
    image.SetSpacing(np.linalg.norm(matrix[:3, :3], axis=0).tolist())
    image.SetDirection((matrix[:3, :3] / image.GetSpacing()).ravel().tolist())
    image.SetOrigin(matrix[:3, 3].tolist())
    path = tmp_path / f"a{kind}"
    sitk.WriteImage(image, str(path), useCompression="zipped" in kind or kind == ".nrrd")
    points = np.array([image.TransformIndexToPhysicalPoint(index) for index in INDICES.tolist()])
    # ITK's world is LPS, NIfTI's RAS.
    assert_there(path, points @ LPS if ".nii" in kind else points, at(INDICES, VALUES), 1e-4)
    assert gk.volume.inspect(path)[0].metadata["geokit:space"] == ("RAS" if ".nii" in kind else "LPS")


@pytest.mark.parametrize("encoding", ["raw", "gzip", "bzip2"])
@pytest.mark.parametrize("dtype", ["<f4", ">i2", "<u1", "<u4"])
def test_files_of_pynrrd(tmp_path: Path, encoding: str, dtype: str) -> None:
    nrrd = pytest.importorskip("nrrd")
    matrix = turned()
    header = {
        "space": "left-posterior-superior",
        "space directions": matrix[:3, :3].T,
        "space origin": matrix[:3, 3],
        "space units": ["mm"] * 3,
        "encoding": encoding,
    }
    nrrd.write(str(tmp_path / "a.nrrd"), VALUES.astype(dtype), header)
    assert_there(tmp_path / "a.nrrd", INDICES @ matrix[:3, :3].T + matrix[:3, 3], at(INDICES, VALUES))
    assert dict(gk.volume.load(tmp_path / "a.nrrd").info.metadata) == {"geokit:unit": "mm", "geokit:space": "LPS"}


def test_a_nrrd_without_a_space(tmp_path: Path) -> None:
    nrrd = pytest.importorskip("nrrd")
    nrrd.write(str(tmp_path / "a.nrrd"), VALUES, {"spacings": [0.5, 2.0, 3.0]})
    np.testing.assert_array_equal(gk.volume.load(tmp_path / "a.nrrd").info.transform, np.diag([0.5, 2.0, 3.0, 1.0]))


@pytest.mark.parametrize(("axis", "kind"), [(0, "vector"), (3, "list")])
def test_vectors_and_lists_of_nrrd(tmp_path: Path, axis: int, kind: str) -> None:
    nrrd = pytest.importorskip("nrrd")
    values = np.stack([VALUES, 2 * VALUES, 3 * VALUES], axis=axis)
    kinds = ["domain"] * 3
    kinds.insert(axis, kind)
    nrrd.write(str(tmp_path / "a.nrrd"), values, {"kinds": kinds})
    volumes = gk.volume.load_all(tmp_path / "a.nrrd")
    found = [gk.volume.to_dense(volume, device="cpu").values for volume in volumes.values()]
    together = np.moveaxis(found[0], 3, 0) if axis == 0 else found
    np.testing.assert_array_equal(together, [VALUES, 2 * VALUES, 3 * VALUES])


@pytest.mark.parametrize("order", [(1, 2, 3), (3, 1, 2), (2, 1, 3)])
@pytest.mark.parametrize("mode", [np.int8, np.int16, np.uint16, np.float32, np.float16])
def test_files_of_mrcfile(tmp_path: Path, order: tuple[int, int, int], mode: type) -> None:
    mrcfile = pytest.importorskip("mrcfile")
    values = (VALUES % 100).astype(mode)
    # Columns, rows and sections are the axes of the world that `order` names.
    stored = values.transpose([at - 1 for at in order]).transpose(2, 1, 0)
    with mrcfile.new(tmp_path / "a.mrc") as file:
        file.set_data(np.ascontiguousarray(stored))
        file.header.mapc, file.header.mapr, file.header.maps = order
        file.header.mx, file.header.my, file.header.mz = SHAPE
        file.header.cella = tuple(size * step for size, step in zip(SHAPE, (0.7, 1.1, 2.3), strict=True))
        file.header.origin = (10.0, -20.0, 35.0)
    volume = gk.volume.load(tmp_path / "a.mrc", background=-5)
    dense = gk.volume.to_dense(volume, device="cpu")
    np.testing.assert_array_equal(dense.values, values)
    np.testing.assert_allclose(volume.info.transform, STRAIGHT, rtol=1e-6)
    assert volume.info.metadata["geokit:unit"] == "angstrom"


def test_an_mrc_that_starts_in_its_cell_and_is_skewed(tmp_path: Path) -> None:
    mrcfile = pytest.importorskip("mrcfile")
    with mrcfile.new(tmp_path / "a.map") as file:
        file.set_data(VALUES.transpose(2, 1, 0).copy())
        file.header.cella = SHAPE
        file.header.cellb = (90.0, 90.0, 120.0)
        file.header.nxstart, file.header.nystart = -2, 4
    transform = gk.volume.load(tmp_path / "a.map").info.transform
    b = [-0.5, np.sqrt(0.75), 0.0]
    np.testing.assert_allclose(transform[:3, :3], np.array([[1.0, 0.0, 0.0], b, [0.0, 0.0, 1.0]]).T, atol=1e-7)
    np.testing.assert_allclose(transform[:3, 3], np.array([-2.0, 0.0, 0.0]) + 4 * np.array(b), atol=1e-6)


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_stacks_of_tifffile(tmp_path: Path, compression: str | None) -> None:
    tifffile = pytest.importorskip("tifffile")
    pages = VALUES.transpose(2, 1, 0).copy()
    tifffile.imwrite(tmp_path / "plain.tif", pages, compression=compression)
    np.testing.assert_array_equal(gk.volume.load(tmp_path / "plain.tif").info.transform, np.eye(4))
    steps = {"PhysicalSizeX": 0.7, "PhysicalSizeY": 1.1, "PhysicalSizeZ": 2.3, "PhysicalSizeXUnit": "mm"}
    steps |= {"PhysicalSizeYUnit": "mm", "PhysicalSizeZUnit": "mm"}
    tifffile.imwrite(tmp_path / "a.ome.tif", pages, metadata={"axes": "ZYX", **steps}, compression=compression)
    facts = {"spacing": 2.3, "unit": "um", "axes": "ZYX"}
    tifffile.imwrite(tmp_path / "ij.tif", pages, imagej=True, resolution=(1 / 0.7, 1 / 1.1), metadata=facts)
    for name, unit in (("plain.tif", None), ("a.ome.tif", "mm"), ("ij.tif", "um")):
        volume = gk.volume.load(tmp_path / name)
        np.testing.assert_array_equal(gk.volume.to_dense(volume, device="cpu").values, VALUES)
        assert volume.info.metadata.get("geokit:unit") == unit
        if unit:
            np.testing.assert_allclose(volume.info.voxel_size, [0.7, 1.1, 2.3], rtol=1e-6)


@pytest.mark.parametrize("kind", ["u2", "i2", "f4", "f8"])
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_tiff_of_the_other_order_of_bytes(tmp_path: Path, kind: str, compression: str | None) -> None:
    tifffile = pytest.importorskip("tifffile")
    pages = (np.arange(5 * 20 * 11).reshape(5, 20, 11) * 7 - 99).astype(kind)
    for order in "<>":
        tifffile.imwrite(tmp_path / "a.tif", pages, byteorder=order, compression=compression)
        volume = gk.volume.load(tmp_path / "a.tif")
        at = np.array([[0, 0, 0], [1, 0, 0], [10, 19, 4], [3, 7, 2]])
        np.testing.assert_array_equal(volume.sample(at.astype(float), order=0), pages[at[:, 2], at[:, 1], at[:, 0]])


def test_pages_of_tiff_that_fit_no_stack_are_told(tmp_path: Path) -> None:
    tifffile = pytest.importorskip("tifffile")
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for rows in (20, 20, 20, 7):
            file.write(np.ones((rows, 11), np.float32), contiguous=False)
    with pytest.warns(UserWarning, match="only its first stack of pages of one size and type is read, not the other 1"):
        assert gk.volume.load(tmp_path / "a.tif").info.active_voxel_count == 3 * 20 * 11
    with tifffile.TiffWriter(tmp_path / "b.tif") as file:
        for count in (2, 5):
            file.write(np.ones((count, 20, 11), np.float32), contiguous=False)
    with pytest.warns(UserWarning, match="only its first stack"):
        assert gk.volume.load(tmp_path / "b.tif").info.active_voxel_count == 2 * 20 * 11


def test_channels_times_and_colors_of_tiff(tmp_path: Path) -> None:
    tifffile = pytest.importorskip("tifffile")
    pages = VALUES.transpose(2, 1, 0)
    channels = np.stack([pages, 2 * pages], axis=1)  # ZCYX
    tifffile.imwrite(tmp_path / "a.ome.tif", channels, metadata={"axes": "ZCYX"})
    tifffile.imwrite(tmp_path / "b.tif", channels, imagej=True, metadata={"axes": "ZCYX"})
    for name in ("a.ome.tif", "b.tif"):
        for number, volume in enumerate(gk.volume.load_all(tmp_path / name).values()):
            np.testing.assert_array_equal(gk.volume.to_dense(volume, device="cpu").values, (number + 1) * VALUES)
    colors = np.stack([pages, pages % 7, pages % 5], axis=-1).astype(np.uint8)
    tifffile.imwrite(tmp_path / "c.tif", colors, photometric="rgb")
    found = gk.volume.to_dense(gk.volume.load(tmp_path / "c.tif"), device="cpu").values
    np.testing.assert_array_equal(found, colors.transpose(2, 1, 0, 3))


@pytest.mark.parametrize("compressor", ["ZLib", "LZ4", None])
def test_images_of_vtk(tmp_path: Path, compressor: str | None) -> None:
    import pyvista
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    matrix = turned()
    spacing = np.linalg.norm(matrix[:3, :3], axis=0)
    image = pyvista.ImageData(dimensions=SHAPE, spacing=spacing, origin=matrix[:3, 3])
    image.direction_matrix = matrix[:3, :3] / spacing
    image.offset = (2, 3, -4)
    image.point_data["density"] = VALUES.ravel(order="F")
    image.point_data["label"] = (VALUES.ravel(order="F") % 9).astype(np.int16)
    writer = vtkXMLImageDataWriter()
    writer.SetInputData(image)
    writer.SetFileName(str(tmp_path / "a.vti"))
    writer.SetCompressorTypeToNone() if compressor is None else getattr(writer, f"SetCompressorTypeTo{compressor}")()
    writer.Write()
    assert_there(tmp_path / "a.vti", np.asarray(image.points), image.point_data["density"], grid="density")
    assert gk.volume.load(tmp_path / "a.vti", grid="label").info.grid_type == "int16"
    cells = pyvista.ImageData(dimensions=np.add(SHAPE, 1), spacing=(0.7, 1.1, 2.3), origin=(1.0, 2.0, 3.0))
    cells.cell_data["density"] = VALUES.ravel(order="F")
    cells.save(tmp_path / "b.vti")
    assert_there(tmp_path / "b.vti", np.asarray(cells.cell_centers().points), cells.cell_data["density"])


@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_of_numpy(tmp_path: Path, order: str) -> None:
    np.save(tmp_path / "a.npy", np.asarray(VALUES, order=order))
    assert_there(tmp_path / "a.npy", INDICES.astype(float), at(INDICES, VALUES))


# --- files of geokit in other libraries -------------------------------------------------------------------------------


def test_nibabel_finds_the_place(tmp_path: Path) -> None:
    nibabel = pytest.importorskip("nibabel")
    for kind in (".nii", ".nii.gz"):
        gk.volume.save(tmp_path / f"a{kind}", volume_at(turned(), unit="mm", space="RAS"))
        image = nibabel.load(tmp_path / f"a{kind}")
        np.testing.assert_array_equal(image.get_fdata(), VALUES)
        np.testing.assert_allclose(nibabel.affines.apply_affine(image.affine, INDICES), world(turned()), atol=1e-4)
        np.testing.assert_allclose(image.get_qform(), image.get_sform(), atol=1e-4)
        assert image.header.get_xyzt_units()[0] == "mm"


@pytest.mark.parametrize("kind", [".nii", ".nii.gz", ".nrrd", ".mha", ".mhd"])
@pytest.mark.parametrize("space", ["RAS", "LPS"])
@pytest.mark.parametrize("codec", [None, "zip", "none"])
def test_simpleitk_finds_the_place_in_the_body(tmp_path: Path, kind: str, space: str, codec: str | None) -> None:
    """Whatever the file's convention, a voxel stays where it is in the patient."""
    sitk = pytest.importorskip("SimpleITK")
    if ".nii" in kind and codec not in (None, "zip" if "gz" in kind else "none"):
        with pytest.raises(gk.InputError, match="is not written with"):
            gk.volume.save(tmp_path / f"a{kind}", volume_at(turned()), codec=codec)
        return
    gk.volume.save(tmp_path / f"a{kind}", volume_at(turned(), space=space), codec=codec)
    image = sitk.ReadImage(str(tmp_path / f"a{kind}"))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(image), VALUES.transpose(2, 1, 0))
    points = np.array([image.TransformIndexToPhysicalPoint(index) for index in INDICES.tolist()])
    np.testing.assert_allclose(points, world(turned()) @ (LPS if space == "RAS" else np.eye(3)), atol=1e-4)
    # And geokit finds it where it was, in the file's convention.
    again = gk.volume.load(tmp_path / f"a{kind}").info
    wanted = in_space(turned(), space, again.metadata["geokit:space"])
    np.testing.assert_allclose(again.transform, wanted, atol=1e-4)


def test_a_volume_of_no_body_is_not_turned(tmp_path: Path) -> None:
    pytest.importorskip("nibabel")
    for kind in (".nii", ".nrrd", ".mha", ".vti"):
        gk.volume.save(tmp_path / f"a{kind}", volume_at(turned()))
        info = gk.volume.load(tmp_path / f"a{kind}").info
        np.testing.assert_allclose(info.transform, turned(), atol=1e-5)
        assert not info.metadata


def test_pynrrd_finds_the_place(tmp_path: Path) -> None:
    nrrd = pytest.importorskip("nrrd")
    gk.volume.save(tmp_path / "a.nrrd", volume_at(turned(), unit="um"))
    values, header = nrrd.read(str(tmp_path / "a.nrrd"))
    np.testing.assert_array_equal(values, VALUES)
    points = INDICES @ header["space directions"] + header["space origin"]
    np.testing.assert_allclose(points, world(turned()), atol=1e-12)


def test_mrcfile_finds_the_place_in_angstrom(tmp_path: Path) -> None:
    mrcfile = pytest.importorskip("mrcfile")
    gk.volume.save(tmp_path / "a.mrc", volume_at(STRAIGHT, unit="nm"))
    assert mrcfile.validate(tmp_path / "a.mrc")
    with mrcfile.open(tmp_path / "a.mrc") as file:
        np.testing.assert_array_equal(file.data, VALUES.transpose(2, 1, 0))
        steps = np.array([file.voxel_size[axis] for axis in "xyz"])
        origin = np.array([file.header.origin[axis] for axis in "xyz"])
    np.testing.assert_allclose(INDICES * steps + origin, 10.0 * world(STRAIGHT), atol=1e-3)


def test_tifffile_finds_the_voxel_size(tmp_path: Path) -> None:
    tifffile = pytest.importorskip("tifffile")
    gk.volume.save(tmp_path / "a.tif", volume_at(STRAIGHT, unit="mm"))
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert file.series[0].axes == "ZYX"
        np.testing.assert_array_equal(file.asarray(), VALUES.transpose(2, 1, 0))
        assert 'PhysicalSizeZ="2.3"' in file.ome_metadata
        assert 'PhysicalSizeZUnit="mm"' in file.ome_metadata
    np.testing.assert_allclose(gk.volume.load(tmp_path / "a.tif").info.transform, STRAIGHT)


def test_vtk_finds_the_place(tmp_path: Path) -> None:
    import pyvista

    gk.volume.save(tmp_path / "a.vti", volume_at(turned()))
    image = pyvista.read(tmp_path / "a.vti")
    np.testing.assert_array_equal(image.point_data["value"], VALUES.ravel(order="F"))
    by_x_first = world(turned()).reshape(*SHAPE, 3).transpose(2, 1, 0, 3).reshape(-1, 3)
    np.testing.assert_allclose(image.points, by_x_first, atol=1e-5)
    assert image.offset == (3, -4, 5)


@pytest.mark.parametrize("kind", [".mrc", ".tif", ".mha", ".vti"])
def test_voxels_that_a_format_cannot_place_are_refused(tmp_path: Path, kind: str) -> None:
    pytest.importorskip("tifffile")
    pytest.importorskip("mrcfile")
    sheared = STRAIGHT.copy()
    sheared[0, 1] = 0.3
    with pytest.raises(gk.InputError, match=rf"a{kind}: the volume's voxels are .*, which the format cannot hold"):
        gk.volume.save(tmp_path / f"a{kind}", volume_at(sheared))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", [".mrc", ".tif", ".zarr"])
@pytest.mark.parametrize(
    "axes", [[[-1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 0, 1], [-1, 0, 0], [0, 1, 0]], [[0, 1, 0], [1, 0, 0], [0, 0, -1]]]
)
def test_axes_parallel_to_the_world_s_are_turned_to_them(
    tmp_path: Path, kind: str, axes: list[list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Formats without directions hold scans too, whose x mostly runs from right to left."""
    pytest.importorskip({".mrc": "mrcfile", ".tif": "tifffile", ".zarr": "zarr"}[kind])
    monkeypatch.setattr(stream, "SLAB_BYTES", 300)
    matrix = STRAIGHT.copy()
    matrix[:3, :3] = np.array(axes) @ STRAIGHT[:3, :3]
    gk.volume.save(tmp_path / f"a{kind}", volume_at(matrix, unit="angstrom"))
    assert (np.diag(gk.volume.load(tmp_path / f"a{kind}").info.transform) > 0.0).all()
    assert_there(tmp_path / f"a{kind}", world(matrix), at(INDICES, VALUES), 1e-4)


def test_npy_says_that_it_has_no_place(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"a\.npy: \.npy holds no place"):
        gk.volume.save(tmp_path / "a.npy", volume_at(STRAIGHT))
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), VALUES)
    gk.volume.save(tmp_path / "b.npy", gk.volume.from_dense(VALUES))


@pytest.mark.parametrize("skip", [-1, 0, 7])
def test_raw_voxels_of_a_nrrd_may_stand_at_the_end_of_their_file(tmp_path: Path, skip: int) -> None:
    before = b"" if skip == 0 else b"header "
    (tmp_path / "a.raw").write_bytes(before + VALUES.astype("<f4").tobytes(order="F"))
    sizes = " ".join(map(str, VALUES.shape))
    lines = ["NRRD0004", "type: float", "dimension: 3", f"sizes: {sizes}", "encoding: raw", "endian: little"]
    (tmp_path / "a.nhdr").write_text("\n".join([*lines, f"byte skip: {skip}", "data file: a.raw", ""]))
    np.testing.assert_array_equal(gk.volume.load(tmp_path / "a.nhdr").to_dense().values, VALUES)


@pytest.mark.parametrize(("skip", "encoding"), [(-2, "raw"), (-1, "gzip")])
def test_other_negative_skips_of_a_nrrd_are_refused(tmp_path: Path, skip: int, encoding: str) -> None:
    (tmp_path / "a.raw").write_bytes(VALUES.astype("<f4").tobytes(order="F"))
    sizes = " ".join(map(str, VALUES.shape))
    lines = ["NRRD0004", "type: float", "dimension: 3", f"sizes: {sizes}", f"encoding: {encoding}", "endian: little"]
    (tmp_path / "a.nhdr").write_text("\n".join([*lines, f"byte skip: {skip}", "data file: a.raw", ""]))
    with pytest.raises(gk.FileFormatError, match=f"skips {skip} bytes; the file is damaged"):
        gk.volume.load(tmp_path / "a.nhdr")
