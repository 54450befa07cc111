"""``geokit`` on PyVista's data sets: what the functions of geokit answer, and isosurfaces that end with the image."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import pyvista

import geokit as gk
from benchmarks.catalog import mesh_catalog

gk.register("pyvista")

BALL = mesh_catalog.icosphere(2)
POINTS = np.random.default_rng(3).uniform(-1.5, 1.5, (40, 3))


def distance_image(size: int = 25, **place: Any) -> pyvista.ImageData:
    """Distances to the middle of a cube of half width 1."""
    step = 2.0 / (size - 1)
    image = pyvista.ImageData(dimensions=(size,) * 3, spacing=(step,) * 3, origin=(-1.0,) * 3)
    image["r"] = np.linalg.norm(image.points, axis=1)
    for name, value in place.items():
        setattr(image, name, value)
    return image


def test_surfaces_answer_as_geokit_does() -> None:
    data, surface = gk.mesh.to_pyvista(BALL), gk.mesh.Surface(BALL)
    np.testing.assert_array_equal(data.geokit.mesh.faces, BALL.faces)
    found = data.geokit.closest_point(POINTS, max_distance=0.5)
    for have, want in zip(found, surface.closest_point(POINTS, max_distance=0.5), strict=True):
        np.testing.assert_array_equal(have, want)
    distances = surface.signed_distance(POINTS, sign="parity").distance
    np.testing.assert_array_equal(data.geokit.signed_distance(POINTS, sign="parity").distance, distances)
    assert data.geokit.surface(device="cpu").device == "cpu"
    volume = data.geokit.to_volume(0.2, device="cpu")
    assert (volume.info.grid_class, volume.info.voxel_size[0]) == ("level set", 0.2)


def test_a_data_set_that_changed_answers_anew() -> None:
    data = gk.mesh.to_pyvista(BALL)
    before = data.geokit.signed_distance([0.0, 0.0, 0.0]).distance
    np.multiply(data.points, 2.0, out=np.asarray(data.points))
    assert data.geokit.signed_distance([0.0, 0.0, 0.0]).distance == pytest.approx(2.0 * before)


def test_images_become_volumes() -> None:
    volume = distance_image(5).geokit.to_volume(background=9.0)
    assert (volume.info.name, volume.info.background, volume.info.voxel_size[0]) == ("r", 9.0, 0.5)


def test_isosurface_of_a_ball() -> None:
    found = distance_image().geokit.isosurface(0.75)
    radii = np.linalg.norm(found.points, axis=1)
    step = 2.0 / 24
    # Linear interpolation of a distance: a share of the squared step over the radius.
    assert np.abs(radii - 0.75).max() < step**2 / 0.75
    assert found.is_manifold
    assert found.volume == pytest.approx(4 / 3 * np.pi * 0.75**3, rel=0.02)


@pytest.mark.parametrize("value", [1.2, 1.45])
def test_isosurface_ends_with_the_image_as_contour_does(value: float) -> None:
    image = distance_image()
    found, contour = image.geokit.isosurface(value), image.contour([value])
    assert found.n_open_edges == contour.n_open_edges > 0
    assert found.area == pytest.approx(contour.area, rel=1e-4)
    np.testing.assert_allclose(found.bounds, contour.bounds, atol=1e-5)


def test_isosurface_of_whole_numbers_in_a_place_of_its_own() -> None:
    turned = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    image = distance_image(spacing=(0.5, 1.0, 2.0), origin=(5.0, 6.0, 7.0), direction_matrix=turned, offset=(3, 0, -2))
    image["r"] = np.round(image["r"] * 1000).astype(np.int16)
    found = image.geokit.isosurface(1200, device="cpu")
    contour = image.cast_to_structured_grid().contour([1200])  # of the image itself VTK forgets the direction
    assert found.area == pytest.approx(contour.area, rel=1e-4)
    np.testing.assert_allclose(found.bounds, contour.bounds, rtol=1e-5)


def test_isosurface_forwards_its_options() -> None:
    fine = distance_image().geokit.isosurface(0.75)
    assert distance_image().geokit.isosurface(0.75, method="surface_nets", tolerance=0.05).n_cells < fine.n_cells / 3


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: pyvista.PolyData(np.eye(3)).geokit.surface(), "mesh: .*faces"),
        (lambda: gk.mesh.to_pyvista(BALL).geokit.to_volume(), "voxel_size: nothing given"),
        (lambda: pyvista.ImageData(dimensions=(3, 3, 3)).geokit.to_volume(), "holds no array"),
        (lambda: distance_image().geokit.isosurface(np.nan), "isovalue: nan is not finite"),
    ],
)
def test_refusals(call: Any, message: str) -> None:
    with pytest.raises(gk.InputError, match=message):
        call()
