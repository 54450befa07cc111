"""The method and reason of "auto": whether the mesh is proven clean."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog


def surface(mesh):
    return gk.mesh.Surface(mesh, device="cpu")


def boxes(*, inner_inward, offset=(0.25, 0.25, 0.25)):
    inner = mesh_catalog.moved(mesh_catalog.scaled(mesh_catalog.box(), 0.5), offset)
    return mesh_catalog.join(mesh_catalog.box(), mesh_catalog.inside_out(inner) if inner_inward else inner)


@pytest.mark.parametrize(
    "mesh",
    [
        mesh_catalog.tetrahedron(),
        mesh_catalog.box(),
        mesh_catalog.icosphere(),
        mesh_catalog.torus(),
        mesh_catalog.l_profile(),
        mesh_catalog.cone(200, 1e4),
        mesh_catalog.inside_out_box(),
        mesh_catalog.soup(mesh_catalog.icosphere()),
        boxes(inner_inward=True),
        mesh_catalog.join(mesh_catalog.box(), mesh_catalog.moved(mesh_catalog.box(), (3, 0, 0))),
        mesh_catalog.scaled(boxes(inner_inward=True), 1e-200),
        mesh_catalog.far_away(boxes(inner_inward=True), 1e6),
    ],
    ids=lambda mesh: mesh.name,
)
def test_clean_meshes_have_pseudonormals(mesh):
    s = surface(mesh)
    assert (s.sign_method, s.sign_reason) == ("pseudonormal", "closed, manifold, wound alike, no intersections")


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (mesh_catalog.holed_sphere(1), "boundary edges: 3"),
        (mesh_catalog.three_on_an_edge(), "boundary edges"),
        (
            mesh_catalog.join(mesh_catalog.box(), mesh_catalog.moved(mesh_catalog.box(), (1, 0, 0))),
            "pairs of faces back to back, which cancel: 2",
        ),
        (
            mesh_catalog.join(mesh_catalog.box(), mesh_catalog.moved(mesh_catalog.box(), (1, 1, 0))),
            "edges of three faces or more",
        ),
        (mesh_catalog.two_boxes_touching_at_a_vertex(), "vertices that separate fans share"),
        (mesh_catalog.overlapping_spheres(), "faces that intersect"),
        (boxes(inner_inward=False), "parts within each other that are not cavities"),
        (boxes(inner_inward=False, offset=(0.75, 0.2, 0.2)), "faces that intersect"),
        (
            mesh_catalog.join(boxes(inner_inward=True), mesh_catalog.moved(boxes(inner_inward=False), (3, 0, 0))),
            "cavities",
        ),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_others_have_winding_numbers_and_say_why(mesh, reason):
    s = surface(mesh)
    assert s.sign_method == "winding"
    assert reason in s.sign_reason


def test_a_cap_without_area_is_a_defect():
    mesh = mesh_catalog.box()
    # An edge of the box is cut in two by a triangle without area; by its edges the mesh is still closed.
    a, b, c = mesh.faces[0]
    middle = len(mesh.vertices)
    vertices = np.concatenate([mesh.vertices, [(mesh.vertices[a] + mesh.vertices[b]) / 2]])
    faces = np.concatenate([[[a, middle, c], [middle, b, c], [b, middle, a]], mesh.faces[1:]])
    s = surface(gk.mesh.TriangleMesh(vertices, faces))
    assert s.audit.watertight
    assert (s.sign_method, s.sign_reason) == ("winding", "faces without area: 1")


@pytest.mark.parametrize("make", [mesh_catalog.torus, lambda: boxes(inner_inward=True)])
def test_auto_is_the_method_that_it_names(make):
    s = surface(make())
    points = s.bounds[0] + np.random.default_rng(0).random((500, 3)) * np.ptp(s.bounds, axis=0)
    for found, named in zip(s.signed_distance(points), s.signed_distance(points, sign=s.sign_method), strict=True):
        np.testing.assert_array_equal(found, named)
    np.testing.assert_array_equal(s.contains(points), s.contains(points, sign="winding"))


def test_a_moved_mesh_is_judged_again():
    mesh = boxes(inner_inward=True)
    s = surface(mesh)
    assert s.sign_method == "pseudonormal"
    vertices = mesh.vertices.copy()
    vertices[8:] += [0.4, 0, 0]
    s.update(vertices)
    assert (s.sign_method, s.sign_reason) == ("winding", "faces that intersect")


@pytest.mark.parametrize("make", [mesh_catalog.torus, mesh_catalog.l_profile, lambda: boxes(inner_inward=True)])
def test_flipped_faces_are_turned_back_first(make):
    mesh = make()
    flipped = surface(mesh_catalog.with_flips(mesh, share=0.2))
    assert flipped.orientation == 0
    assert flipped.sign_method == "pseudonormal"
    rng = np.random.default_rng(1)
    points = flipped.bounds[0] + (rng.random((2000, 3)) * 1.2 - 0.1) * np.ptp(flipped.bounds, axis=0)
    for sign in ("auto", "winding", "parity"):
        # Corners in another order round differently.
        found, expected = flipped.signed_distance(points, sign=sign), surface(mesh).signed_distance(points)
        np.testing.assert_allclose(found.distance, expected.distance, rtol=0, atol=1e-14)
    np.testing.assert_allclose(flipped.winding_number(points), surface(mesh).winding_number(points), atol=0.005)
