"""Signs beside meshes that enclose nothing: by the normals of their faces, or with a warning that they mean nothing."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.mesh import Surface, Surfaces, TriangleMesh
from tests.support.devices import DEVICES

SIDE = 10.0
ABOVE = 0.2


def height_field(height: Callable, cells: int = 60) -> TriangleMesh:
    """A sheet over a square, wound so that its normals point up."""
    axis = np.linspace(0.0, SIDE, cells + 1)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    at = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    quads = [[at, at + cells + 1, at + cells + 2], [at, at + cells + 2, at + 1]]
    faces = np.concatenate([np.stack(corners, axis=1) for corners in quads])
    return TriangleMesh(np.stack([x, y, height(x, y)], axis=-1).reshape(-1, 3), faces)


def hills(x, y):
    return 0.5 * np.sin(1.3 * x) * np.cos(0.9 * y) + 0.1 * np.sin(7 * x)


def pit(x, y):
    return -8.0 * np.exp(-((x - 5.0) ** 2 + (y - 5.0) ** 2) / 4.0)


def rough(x, y):
    return np.random.default_rng(0).normal(scale=0.2, size=x.shape)


SHEETS = {
    "plane": height_field(lambda x, y: 0.0 * x),
    "hills": height_field(hills),
    "pit": height_field(pit),
    "rough": height_field(rough),
    "in separate triangles": mesh_catalog.soup(height_field(hills)),
    "two layers": mesh_catalog.join(height_field(hills), mesh_catalog.moved(height_field(hills), (0.0, 0.0, -5.0))),
    "with holes": mesh_catalog.with_holes(height_field(hills), 0.05),
}


def beside(mesh: TriangleMesh, count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Points off the middles of faces along their normals, and the height above the sheet over the mesh's plan."""
    rng = np.random.default_rng(1)
    faces = rng.choice(mesh.face_count, count, replace=False)
    side = rng.choice([-1.0, 1.0], count)
    reach = 0.01 * rng.random(count)
    return mesh.vertices[mesh.faces[faces]].mean(axis=1) + (side * reach)[:, None] * mesh.face_normals[faces], side


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", SHEETS)
def test_the_normals_tell_the_sides(name: str, device: str, recwarn: pytest.WarningsRecorder) -> None:
    mesh = SHEETS[name]
    surface = Surface(mesh, device=device)
    assert surface.sign_method == "pseudonormal"
    assert "encloses nothing" in surface.sign_reason
    points, side = beside(mesh)
    distance = surface.signed_distance(points).distance
    assert np.array_equal(np.sign(distance), side)
    assert np.array_equal(surface.contains(points), side < 0)
    assert np.array_equal(Surfaces([mesh, mesh], device=device).contains(np.stack([points, points]))[1], side < 0)
    turned = Surface(TriangleMesh(mesh.vertices, mesh.faces[:, ::-1]), device=device)
    np.testing.assert_allclose(turned.signed_distance(points).distance, -distance, atol=1e-14)
    assert not [said for said in recwarn if issubclass(said.category, UserWarning)]


def test_a_plane_has_its_distance_on_both_sides() -> None:
    surface = Surface(SHEETS["plane"], device="cpu")
    points = np.array([[3.0, 4.0, ABOVE], [3.0, 4.0, -ABOVE], [0.1, 9.0, -ABOVE]])
    np.testing.assert_allclose(surface.signed_distance(points).distance, [ABOVE, -ABOVE, -ABOVE], rtol=1e-15)


def moebius(around: int = 40, across: int = 3) -> TriangleMesh:
    angle, width = np.linspace(0, 2 * np.pi, around, endpoint=False), np.linspace(-0.3, 0.3, across + 1)
    a, w = np.meshgrid(angle, width, indexing="ij")
    ring = 1.0 + w * np.cos(a / 2.0)
    vertices = np.stack([ring * np.cos(a), ring * np.sin(a), w * np.sin(a / 2.0)], axis=-1).reshape(-1, 3)
    faces = []
    for i in range(around):
        for j in range(across):
            one, two = i * (across + 1) + j, i * (across + 1) + j + 1
            next_one, next_two = (
                (across - j, across - j - 1) if i == around - 1 else (one + across + 1, two + across + 1)
            )
            faces += [[one, next_one, next_two], [one, next_two, two]]
    return TriangleMesh(vertices, np.array(faces), name="ribbon")


def leaves(count: int = 300) -> TriangleMesh:
    rng = np.random.default_rng(2)
    corners = rng.uniform(0.0, SIDE, (count, 1, 3)) + rng.normal(scale=0.1, size=(count, 3, 3))
    return TriangleMesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def doubled(mesh: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[:, ::-1]]))


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (moebius(), "cannot be wound alike"),
        (leaves(), "consists of loose faces"),
        (mesh_catalog.crossing_sheets(), "edges of three faces or more"),
        (doubled(SHEETS["plane"]), "faces back to back, which cancel: 7200"),
    ],
)
def test_signs_that_mean_nothing_are_said_once(mesh: TriangleMesh, reason: str) -> None:
    surface = Surface(mesh, device="cpu")
    points = mesh.bounds.mean(axis=0) + np.random.default_rng(3).normal(size=(5, 3))
    said = rf"{mesh.name or 'mesh'}: encloses nothing .*{reason}.* signs of its distances mean nothing"
    with pytest.warns(UserWarning, match=said) as given:
        surface.signed_distance(points)
    assert given[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        surface.signed_distance(points)
        surface.contains(points)
        Surface(mesh, device="cpu").signed_distance(points, sign="winding")
        Surface(mesh, device="cpu").closest_point(points)
        assert surface.sign_method == "winding"
    with pytest.warns(UserWarning, match=said):
        Surfaces([mesh_catalog.box(), mesh], device="cpu").contains(np.stack([points, points]))


@pytest.mark.parametrize(
    ("mesh", "closed"),
    [
        (mesh_catalog.holed_sphere(), False),
        (mesh_catalog.with_holes(mesh_catalog.icosphere(3), 0.2), False),
        (mesh_catalog.with_large_hole(mesh_catalog.icosphere(3), 0.15), False),
        (mesh_catalog.spherical_cap(0.5), False),
        (mesh_catalog.box_without_a_lid(), False),
        (mesh_catalog.open_cylinder(), False),
        (mesh_catalog.inside_out(mesh_catalog.holed_sphere()), False),
        (mesh_catalog.join(SHEETS["hills"], mesh_catalog.moved(mesh_catalog.icosphere(), (5.0, 5.0, 4.0))), True),
        (mesh_catalog.icosphere(), True),
    ],
)
def test_bodies_keep_their_method(mesh: TriangleMesh, closed: bool, recwarn: pytest.WarningsRecorder) -> None:
    surface = Surface(mesh, device="cpu")
    assert (surface.sign_method, surface.sign_reason) == surface._solid_choice[:2]
    assert (surface.sign_method == "winding") == (mesh_catalog.icosphere().face_count != mesh.face_count or not closed)
    surface.signed_distance(mesh.vertices[:2] + 0.1)
    assert not [said for said in recwarn if issubclass(said.category, UserWarning)]


@pytest.mark.parametrize("scale", [1e-60, 1e-6, 1e6, 1e60])
def test_sheets_of_any_size_in_any_place(scale: float) -> None:
    mesh, (points, side) = SHEETS["hills"], beside(SHEETS["hills"])
    shift = np.array([1e4, -1e4, 3e3]) * scale
    surface = Surface(TriangleMesh(mesh.vertices * scale + shift, mesh.faces), device="cpu")
    assert surface.sign_method == "pseudonormal"
    far = np.abs(Surface(mesh, device="cpu").closest_point(points).distance) > 1e-6
    assert np.array_equal(np.sign(surface.signed_distance(points * scale + shift).distance)[far], side[far])


@pytest.mark.filterwarnings("ignore:mesh")
def test_a_field_of_a_sheet_is_as_before() -> None:
    """A volume says what is inside, and a sheet has no inside: its signs stay those of winding numbers."""
    field = gk.volume.from_mesh(SHEETS["plane"], 0.5, device="cpu")
    assert field.info.metadata["geokit:sign_method"] == "winding"
    assert field.info.metadata["geokit:sign_reason"].startswith("boundary edges")
