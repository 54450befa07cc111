"""Signs of meshes with faces that lie back to back: one of two counts on closed components."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.mesh import Surface, TriangleMesh
from tests.support import reference
from tests.support.devices import DEVICES

SIGNS = ("auto", "winding", "pseudonormal", "parity")
CLOSED = [mesh_catalog.box(), mesh_catalog.icosphere(), mesh_catalog.torus()]
SMALL_BOX = mesh_catalog.moved(mesh_catalog.scaled(mesh_catalog.box(), 0.5), (0.25, 0.25, 0.25))
WALL = TriangleMesh([[0.5, 0, 0], [0.5, 1, 0], [0.5, 1, 1], [0.5, 0, 1]], [[0, 1, 2], [0, 2, 3]], name="wall")


def around(mesh, count=1500, seed=11):
    size = np.ptp(mesh.bounds, axis=0)
    return mesh.bounds[0] - 0.2 * size + 1.4 * size * np.random.default_rng(seed).random((count, 3))


def shuffled(mesh, seed=12):
    faces = np.random.default_rng(seed).permutation(mesh.faces)
    return TriangleMesh(mesh.vertices, faces, name=f"{mesh.name}_shuffled")


def require_inside_of(mesh, expected, signs=SIGNS, device="cpu"):
    """Every answer about the side is that of ``expected``, far and near; what is nearest is that of the mesh itself."""
    surface, points = Surface(mesh, device=device), around(expected)
    inside = reference.winding_number(expected.vertices, expected.faces, points) > 0.5
    assert 0 < inside.sum() < len(points)
    nearest = surface.closest_point(points)
    for sign in signs:
        np.testing.assert_array_equal(surface.contains(points, sign=sign), inside)
        found = surface.signed_distance(points, sign=sign)
        np.testing.assert_array_equal(found.distance, np.where(inside, -nearest.distance, nearest.distance))
        np.testing.assert_array_equal(found.triangle_id, nearest.triangle_id)
        bounded = surface.signed_distance(points, sign=sign, max_distance=0.1)
        np.testing.assert_array_equal(bounded.distance < 0, inside)
    return surface


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("some", [slice(None), slice(0, 1), slice(3, 9)], ids=["all", "one", "some"])
@pytest.mark.parametrize("mesh", CLOSED, ids=lambda mesh: mesh.name)
def test_a_closed_mesh_keeps_its_inside(mesh, some, device):
    surface = require_inside_of(mesh_catalog.doubled(mesh, some), mesh, device=device)
    assert (surface.sign_method, surface.is_closed, surface.orientation) == ("pseudonormal", True, 1)
    count = len(mesh.faces[some])
    assert surface.sign_reason.startswith(f"{count} faces back to back with others are left out; closed")


@pytest.mark.parametrize("mesh", CLOSED, ids=lambda mesh: mesh.name)
def test_the_order_of_faces_and_separate_vertices_change_nothing(mesh):
    require_inside_of(shuffled(mesh_catalog.doubled(mesh)), mesh)
    require_inside_of(mesh_catalog.soup(shuffled(mesh_catalog.doubled(mesh))), mesh)
    require_inside_of(mesh_catalog.doubled(mesh_catalog.inside_out(mesh)), mesh)


@pytest.mark.parametrize("share", [0.003, 0.03, 0.3, 0.7, 0.97, 1.0])
def test_any_share_of_doubled_faces(share):
    mesh = mesh_catalog.torus(32, 16)
    some = np.random.default_rng(13).permutation(len(mesh.faces))[: max(1, round(share * len(mesh.faces)))]
    faces = np.concatenate([mesh.faces, mesh.faces[some, ::-1]])
    surface = require_inside_of(shuffled(TriangleMesh(mesh.vertices, faces)), mesh)
    assert surface.audit.back_to_back_count == len(some)


def test_copies_count_once_whatever_their_number():
    mesh = mesh_catalog.icosphere()
    faces = np.concatenate([mesh.faces, mesh.faces[:, ::-1], mesh.faces[:, ::-1], mesh.faces[:40]])
    surface = require_inside_of(TriangleMesh(mesh.vertices, faces), mesh)
    np.testing.assert_allclose(surface.winding_number([[0, 0, 0], [3, 0, 0]]), [1, 0], atol=0.005)


def test_open_sheets_of_two_sides_have_no_inside():
    for mesh in (mesh_catalog.open_shell(), mesh_catalog.spherical_cap(0.7), mesh_catalog.single_triangle()):
        surface = Surface(mesh_catalog.doubled(mesh), device="cpu")
        points = around(mesh)
        with pytest.warns(UserWarning, match="signs of its distances mean nothing"):
            assert not surface.contains(points).any()
        np.testing.assert_allclose(surface.winding_number(points), 0.0, atol=0.005)
        assert surface.sign_method == "winding"
        assert surface.sign_reason.endswith(f"pairs of faces back to back, which cancel: {len(mesh.faces)}")


@pytest.mark.parametrize(
    ("mesh", "expected", "reason"),
    [
        # A wall in a room, the contact of two bodies, and a core that fills the cavity of its shell.
        (
            mesh_catalog.join(mesh_catalog.box(), mesh_catalog.doubled(WALL)),
            mesh_catalog.box(),
            "4 faces of open sheets inside of bodies are left out",
        ),
        (
            mesh_catalog.join(mesh_catalog.box(), mesh_catalog.moved(mesh_catalog.box(), (1, 0, 0))),
            mesh_catalog.join(mesh_catalog.box(), mesh_catalog.moved(mesh_catalog.box(), (1, 0, 0))),
            "pairs of faces back to back, which cancel: 2",
        ),
        (
            mesh_catalog.join(mesh_catalog.box(), mesh_catalog.doubled(SMALL_BOX)),
            mesh_catalog.box(),
            "pairs of faces back to back, which cancel: 12",
        ),
    ],
    ids=["wall", "contact", "core"],
)
def test_faces_within_a_solid_cancel(mesh, expected, reason):
    surface = require_inside_of(mesh, expected, signs=("auto", "winding"))
    assert surface.sign_reason.startswith(reason)


def test_components_are_judged_one_by_one():
    # A doubled body, a doubled sheet and a plain body side by side.
    ball = mesh_catalog.moved(mesh_catalog.icosphere(), (3, 0, 0))
    sheet = mesh_catalog.moved(mesh_catalog.sheet(), (-3, 0, 0))
    mesh = mesh_catalog.join(mesh_catalog.doubled(ball), mesh_catalog.doubled(sheet), mesh_catalog.box())
    require_inside_of(mesh, mesh_catalog.join(ball, mesh_catalog.box()), signs=("auto", "winding"))


def test_a_moved_mesh_is_judged_again():
    one = mesh_catalog.icosphere()
    mesh = mesh_catalog.join(one, mesh_catalog.inside_out(one))
    surface = Surface(mesh, device="cpu")
    assert surface.contains([[0, 0, 0]]).all()
    other = one.vertices + np.array([5.0, 0.0, 0.0])
    surface.update(np.concatenate([one.vertices, other]))
    np.testing.assert_array_equal(surface.contains([[0, 0, 0], [5, 0, 0], [2.5, 0, 0]]), [True, True, False])
    assert "left out" not in surface.sign_reason
    surface.update(mesh.vertices)
    assert "left out" in surface.sign_reason


@pytest.mark.parametrize("scale", [1e-60, 1e60])
def test_scale_changes_nothing(scale):
    mesh = mesh_catalog.doubled(mesh_catalog.torus())
    points = around(mesh)
    expected = Surface(mesh, device="cpu").contains(points)
    found = Surface(mesh_catalog.scaled(mesh, scale), device="cpu").contains(points * scale)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("mesh", CLOSED, ids=lambda mesh: mesh.name)
def test_fields_of_doubled_meshes_have_an_inside(mesh):
    voxel_size = 0.09
    found, expected = (gk.volume.from_mesh(m, voxel_size, device="cpu") for m in (mesh_catalog.doubled(mesh), mesh))
    points = np.round(around(mesh, 4000) / voxel_size) * voxel_size
    values = [grid.sample(points, order=0, device="cpu") for grid in (found, expected)]
    np.testing.assert_allclose(*values, atol=1e-7)
    assert (values[0] < 0).any()


def test_fields_of_doubled_sheets_name_thickness():
    mesh = mesh_catalog.doubled(mesh_catalog.open_shell())
    with pytest.warns(UserWarning, match=r"288 pairs of faces back to back that bound no volume.* use thickness"):
        grid = gk.volume.from_mesh(mesh, 0.1, device="cpu")
    assert grid.info.metadata["geokit:lost_components"] == "0"
    thick = gk.volume.from_mesh(mesh, 0.1, thickness=0.3, device="cpu")
    np.testing.assert_allclose(thick.sample([[0, 0, 0]], device="cpu"), -0.15, atol=0.01)


def of_polygons(polygons):
    """Triangles of polygons as files of polygons are read: fans from the first corner."""
    return [(p[0], p[i], p[i + 1]) for p in polygons for i in range(1, len(p) - 1)]


BOX_QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
BOX_CORNERS = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
# Convex caps of seven corners, whose fans from both ends share some triangles.
ROUND = 2 * np.pi * np.arange(7) / 7
PRISM_CORNERS = np.array([[np.cos(t), np.sin(t), z] for z in (0.0, 1.0) for t in ROUND])
PRISM = [tuple(range(6, -1, -1)), tuple(range(7, 14)), *((i, (i + 1) % 7, 7 + (i + 1) % 7, 7 + i) for i in range(7))]


@pytest.mark.parametrize(
    ("corners", "polygons"), [(BOX_CORNERS, BOX_QUADS), (PRISM_CORNERS, PRISM)], ids=["box", "prism"]
)
@pytest.mark.parametrize("seed", range(3))
def test_polygons_written_for_each_side_may_have_other_triangles(corners, polygons, seed):
    random = np.random.default_rng(seed)
    pose = np.linalg.qr(random.normal(size=(3, 3)))[0] if seed else np.eye(3)
    # Coordinates as text files have them.
    corners = np.round(corners @ pose.T, 6)
    backs = [tuple(np.roll(p[::-1], random.integers(len(p)) if seed else 0)) for p in polygons]
    plain = TriangleMesh(corners, of_polygons(polygons))
    if np.linalg.det(pose) < 0:
        plain = TriangleMesh(corners, plain.faces[:, ::-1])
    mesh = TriangleMesh(
        np.concatenate([corners, corners]), of_polygons(polygons + [tuple(i + len(corners) for i in p) for p in backs])
    )
    for given in (mesh, shuffled(mesh), mesh_catalog.soup(mesh)):
        surface = require_inside_of(given, plain, signs=("auto", "winding", "pseudonormal"))
        assert surface.is_closed
        assert surface.sign_reason.startswith(f"{len(plain.faces)} faces back to back with others are left out")


def test_flat_polygons_of_one_side_stay():
    # Neither a body with coplanar faces around an edge of four nor the contact of two bodies has a side to leave out.
    two = mesh_catalog.join(mesh_catalog.box(), mesh_catalog.moved(mesh_catalog.box(), (1, 1, 0)))
    assert "left out" not in require_inside_of(two, two, signs=("auto", "winding")).sign_reason
    rim = np.stack([np.cos(ROUND), np.sin(ROUND), np.zeros(7)], axis=1)
    around = [(i, (i + 1) % 7) for i in range(7)]
    lens = TriangleMesh(
        np.concatenate([rim, [[0, 0, 4e-4], [0, 0, -4e-4]]]),
        [(i, j, 7) for i, j in around] + [(j, i, 8) for i, j in around],
    )
    both = Surface(mesh_catalog.join(mesh_catalog.moved(lens, (5, 0, 0)), two), device="cpu")
    assert both.contains([[5, 0, 1e-4], [5, 0, -1e-4]]).all()
    assert "left out" not in both.sign_reason
    other = [tuple(np.roll(q, 1)) for q in BOX_QUADS]
    contact = TriangleMesh(
        np.concatenate([BOX_CORNERS, BOX_CORNERS + np.array([1.0, 0.0, 0.0])]),
        of_polygons(BOX_QUADS + [tuple(i + 8 for i in q) for q in other]),
    )
    assert "left out" not in require_inside_of(contact, contact, signs=("auto", "winding")).sign_reason
