"""Operations that renumber a mesh: each attribute equals what its vertex, face or corner had before."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.mesh.attributes.derived import moved_to_corners, turned_normals
from tests.support.attributed import numbered, painted


def dirty(seed: int) -> gk.mesh.TriangleMesh:
    """A torus and a box with duplicate faces, faces without area, flipped ones and vertices that no face uses."""
    random = np.random.default_rng(seed)
    mesh = mesh_catalog.join(mesh_catalog.torus(6, 5), mesh_catalog.box(), mesh_catalog.unreferenced_vertices())
    faces = np.concatenate([mesh.faces, mesh.faces[:4], np.repeat(mesh.faces[:3, :1], 3, axis=1)])
    faces = np.where(random.random(len(faces))[:, None] < 0.3, faces[:, ::-1], faces)
    parts = (gk.mesh.MeshPart("one", 0, 40), gk.mesh.MeshPart("two", 40, len(faces) - 40))
    return numbered(gk.mesh.TriangleMesh(mesh.vertices, faces, parts=parts))


def assert_follows(mesh: gk.mesh.TriangleMesh, source: gk.mesh.TriangleMesh) -> None:
    """Compare positions and attributes through the numbers that the attributes are."""
    assert (mesh.materials, mesh.meters_per_unit) == (source.materials, source.meters_per_unit)
    vertex, face = mesh.vertex_data["v"].astype(int), mesh.face_data["f"].astype(int)
    np.testing.assert_array_equal(mesh.vertices, source.vertices[vertex])
    for name, values in source.vertex_data.items():
        assert mesh.vertex_data[name].dtype == values.dtype
        np.testing.assert_array_equal(mesh.vertex_data[name], values[vertex])
    for name, values in source.face_data.items():
        np.testing.assert_array_equal(mesh.face_data[name], values[face])
    corner = mesh.corner_data["c"].astype(int)
    np.testing.assert_array_equal(corner // 3, np.repeat(face[:, None], 3, axis=1))
    # Each corner lies where the corner lay that its attribute comes from.
    source_corners = source.vertices[source.faces].reshape(-1, 3)
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], source_corners[corner])
    np.testing.assert_array_equal(mesh.corner_data["c2"], source.corner_data["c2"].reshape(-1, 2)[corner])


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_attributes_follow_repairs(seed):
    mesh = dirty(seed)
    assert_follows(gk.mesh.drop_degenerate(mesh, duplicates=True, unreferenced=True), mesh)
    assert_follows(gk.mesh.drop_degenerate(mesh), mesh)


def test_attributes_follow_orient():
    mesh = dirty(3)
    found = gk.mesh.orient(mesh)
    assert found.flipped.any()
    assert not found.flipped.all()
    assert_follows(found.mesh, mesh)


def test_merged_vertices_that_agree_keep_their_attribute():
    soup = mesh_catalog.soup(mesh_catalog.torus(6, 5))
    height = soup.vertices[:, 2].astype(np.float32)
    merged = gk.mesh.merge_vertices(gk.mesh.TriangleMesh(soup.vertices, soup.faces, vertex_data={"height": height}))
    assert merged.vertex_count == 30
    np.testing.assert_array_equal(merged.vertex_data["height"], merged.vertices[:, 2].astype(np.float32))
    assert not merged.corner_data


@pytest.mark.parametrize("tolerance", [0.0, 1e-3])
def test_merged_vertices_that_differ_leave_their_values_to_the_corners(tolerance):
    soup = numbered(mesh_catalog.soup(mesh_catalog.torus(6, 5)))
    merged = gk.mesh.merge_vertices(soup, tolerance=tolerance)
    assert merged.vertex_count == 30
    assert not merged.vertex_data
    for name, values in soup.vertex_data.items():
        np.testing.assert_array_equal(merged.corner_data[name], values[soup.faces])
    for name, values in soup.corner_data.items():
        np.testing.assert_array_equal(merged.corner_data[name], values)


def test_missing_values_at_merged_vertices_agree():
    triangle = gk.mesh.TriangleMesh(np.eye(3)[[0, 1, 2, 0]], [[0, 1, 2], [3, 2, 1]], vertex_data={"a": [np.nan] * 4})
    assert gk.mesh.merge_vertices(triangle).vertex_data["a"].shape == (3,)
    assert moved_to_corners(triangle, np.arange(4), np.arange(4)) is triangle


def test_moved_surfaces_keep_them():
    surface = gk.mesh.Surface(painted(mesh_catalog.box()), device="cpu")
    before = surface.mesh
    surface.update(before.vertices * 2.0)
    np.testing.assert_array_equal(surface.mesh.corner_data["uv"], before.corner_data["uv"])
    assert surface.mesh.materials == before.materials


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-150, 150))
def test_normals_stay_orthogonal_to_their_planes(seed, exponent):
    random = np.random.default_rng(seed)
    linear = random.normal(size=(3, 3))
    first, second = random.normal(size=(2, 40, 3))
    normal = np.cross(first, second)
    turned = turned_normals({"normal": normal}, linear * 10.0**exponent)["normal"]
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), np.linalg.norm(normal, axis=1), rtol=1e-12)
    moved = [vectors @ linear.T for vectors in (first, second)]
    conditioned = np.linalg.cond(linear)
    for vectors in moved:
        cosine = np.einsum("ij,ij->i", turned, vectors) / np.linalg.norm(turned, axis=1)
        assert np.abs(cosine / np.linalg.norm(vectors, axis=1)).max() < 1e-13 * conditioned**2
    # Outside stays outside: the normal of a mirrored plane is not that of its mirrored edges.
    reference = np.cross(*moved) * np.sign(np.linalg.det(linear))
    assert (np.einsum("ij,ij->i", turned, reference) > 0.0).all()


def test_only_normals_turn():
    data = {"normal": np.zeros((2, 3)), "flow": np.ones((2, 3)), "color": np.ones((2, 3))}
    turned = turned_normals(data, np.diag([1.0, 2.0, -3.0]))
    assert turned["flow"] is data["flow"]
    assert turned["color"] is data["color"]
    np.testing.assert_array_equal(turned["normal"], 0.0)
    scalar = {"normal": np.ones((2, 3))}
    assert turned_normals(scalar, np.eye(3), axes=2) is scalar
