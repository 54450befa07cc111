"""Dense volumes of other libraries in and out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import pyvista

import geokit as gk

VALUES = np.random.default_rng(5).random((4, 5, 6)) + 1.0


def _image(values: np.ndarray, **place: Any) -> Any:
    image = pyvista.ImageData(dimensions=values.shape[:3], **place)
    image["density"] = values.reshape(-1, order="F") if values.ndim == 3 else values.reshape(-1, 3, order="F")
    return image


def _turned() -> np.ndarray:
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    transform = np.eye(4)
    transform[:3, :3] = turn * [0.5, 1.0, 2.0]
    transform[:3, 3] = [7.0, 8.0, 9.0]
    return transform


def test_images_of_points() -> None:
    image = _image(VALUES, spacing=(0.5, 1.0, 2.0), origin=(7.0, 8.0, 9.0))
    found = gk.volume.from_dense(image, grid_type="double")
    assert found.info.name == "density"
    # VTK's own places of the values.
    np.testing.assert_array_equal(found.sample(image.points, order=0, device="cpu"), image["density"])


def test_images_of_cells_have_values_at_their_middles() -> None:
    image = pyvista.ImageData(dimensions=(5, 6, 7), spacing=(0.5, 1.0, 2.0), origin=(7.0, 8.0, 9.0))
    image.cell_data["density"] = VALUES.ravel(order="F")
    found = gk.volume.from_dense(image, grid_type="double")
    centers = image.cell_centers().points
    np.testing.assert_array_equal(found.sample(centers, order=0, device="cpu"), image.cell_data["density"])


def test_images_with_directions_and_offsets() -> None:
    image = _image(VALUES, spacing=(0.5, 1.0, 2.0), origin=(7.0, 8.0, 9.0), offset=(3, -4, 5))
    image.direction_matrix = _turned()[:3, :3] / [0.5, 1.0, 2.0]
    found = gk.volume.from_dense(image, grid_type="double")
    np.testing.assert_array_equal(found.info.index_bounds[0], [3, -4, 5])
    np.testing.assert_array_equal(found.sample(image.points, order=0, device="cpu"), image["density"])


def test_images_of_several_arrays_need_an_active_one() -> None:
    image = pyvista.ImageData(dimensions=(2, 2, 2))
    image.point_data.set_array(np.zeros(8), "a")
    image.point_data.set_array(np.ones(8), "b")
    image.point_data.active_scalars_name = None
    with pytest.raises(gk.InputError, match=r"holds 'a', 'b', none active; choose with set_active_scalars"):
        gk.volume.from_dense(image)
    image.set_active_scalars("b")
    assert gk.volume.from_dense(image).info.name == "b"
    with pytest.raises(gk.InputError, match="no array"):
        gk.volume.from_dense(pyvista.ImageData(dimensions=(2, 2, 2)))


def test_arguments_come_before_what_the_object_says() -> None:
    found = gk.volume.from_dense(_image(VALUES, spacing=(0.5, 1.0, 2.0)), voxel_size=3.0, origin=(1, 1, 1), name="x")
    assert (found.info.name, found.info.voxel_size[0]) == ("x", 3.0)
    assert found.info.index_bounds[0].tolist() == [1, 1, 1]


@pytest.mark.parametrize("transform", [np.diag([0.5, 1.0, 2.0, 1.0]), _turned()])
@pytest.mark.parametrize("library", ["pyvista", "xarray", "dense"])
@pytest.mark.parametrize("shape", [(4, 5, 6), (4, 5, 6, 3)])
def test_out_and_in_again(library: str, transform: np.ndarray, shape: tuple[int, ...]) -> None:
    if library == "xarray":
        pytest.importorskip("xarray")
    values = np.random.default_rng(6).random(shape).astype(np.float32) + 1.0
    volume = gk.volume.from_dense(values, transform=transform, origin=(3, -4, 5), name="density")
    out = volume.to_dense if library == "dense" else getattr(gk.volume, f"to_{library}")
    made = out(device="cpu") if library == "dense" else out(volume, device="cpu")
    back = gk.volume.from_dense(made)
    points = np.random.default_rng(7).random((50, 3)) * 4.0 + transform[:3, :3] @ [3, -4, 5] + transform[:3, 3]
    expected = volume.sample(points, device="cpu")
    np.testing.assert_allclose(back.sample(points, device="cpu"), expected, rtol=1e-9, atol=1e-12)
    assert np.abs(expected).max() > 1.0
    assert library == "dense" or back.info.name == "density"


def test_sheared_voxels_are_no_image() -> None:
    sheared = np.eye(4)
    sheared[0, 1] = 0.5
    volume = gk.volume.from_dense(VALUES, transform=sheared)
    with pytest.raises(gk.InputError, match="sheared"):
        gk.volume.to_pyvista(volume)


def test_nothing_active_has_no_box() -> None:
    with pytest.raises(gk.InputError, match="no active voxel; give bounds"):
        gk.volume.to_pyvista(gk.volume.from_dense(np.zeros((2, 2, 2))))


class TestLabeled:
    def test_dimensions_are_told_by_name(self) -> None:
        xarray = pytest.importorskip("xarray")
        axes = {"z": np.arange(6) * 2.0 + 9.0, "y": np.arange(5) + 8.0, "x": np.arange(4) * 0.5 + 7.0}
        array = xarray.DataArray(VALUES.transpose(2, 1, 0), coords=axes, dims=["z", "y", "x"], name="t")
        found = gk.volume.from_dense(array, grid_type="double")
        places = np.stack(np.meshgrid(axes["x"], axes["y"], axes["z"], indexing="ij"), axis=-1).reshape(-1, 3)
        np.testing.assert_array_equal(found.sample(places, order=0, device="cpu"), VALUES.ravel())
        assert found.info.name == "t"

    def test_uneven_coordinates_are_refused(self) -> None:
        xarray = pytest.importorskip("xarray")
        array = xarray.DataArray(VALUES, coords={"x": [0.0, 1.0, 2.0, 4.0]}, dims=["x", "y", "z"])
        with pytest.raises(gk.InputError, match="coordinates along 'x' are not evenly spaced"):
            gk.volume.from_dense(array)

    def test_dimensions_of_space_are_three(self) -> None:
        xarray = pytest.importorskip("xarray")
        with pytest.raises(gk.InputError, match="has the dimensions a, b; a volume has x, y and z"):
            gk.volume.from_dense(xarray.DataArray(np.ones((2, 2)), dims=["a", "b"]))


def test_the_default_voxel_is_one() -> None:
    assert gk.volume.from_dense(VALUES).info.voxel_size.tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize("size", [1e-300, 1e300])
def test_voxels_that_images_cannot_have(size: float) -> None:
    volume = gk.volume.from_dense(np.ones((2, 2, 2), np.float32), voxel_size=size)
    with pytest.raises(gk.InputError, match="leave the range of images"):
        gk.volume.to_pyvista(volume)
