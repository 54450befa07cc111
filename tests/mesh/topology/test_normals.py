"""Normals, area and volume of a mesh against plain float64 loops and analytic bodies."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog


def by_hand(mesh):
    """Angle-weighted vertex normals, corner by corner; vertices at one position are one."""
    sums = {}
    for face in mesh.vertices[mesh.faces]:
        normal = np.cross(face[1] - face[0], face[2] - face[0])
        if not normal.any():
            continue
        normal = normal / np.linalg.norm(normal)
        for k in range(3):
            p, q = face[(k + 1) % 3] - face[k], face[(k + 2) % 3] - face[k]
            angle = np.arccos(np.clip(p @ q / np.linalg.norm(p) / np.linalg.norm(q), -1, 1))
            key = tuple(face[k] + 0.0)
            sums[key] = sums.get(key, 0.0) + angle * normal
    return np.array([sums.get(tuple(vertex + 0.0), np.zeros(3)) for vertex in mesh.vertices])


@pytest.mark.parametrize(
    "mesh",
    [
        mesh_catalog.torus(9, 7),
        mesh_catalog.soup(mesh_catalog.icosphere(1)),
        mesh_catalog.l_profile(),
        mesh_catalog.moved(mesh_catalog.box(), (1e6, 0, 0)),
        mesh_catalog.open_shell(5),
    ],
    ids=["torus", "soup", "profile", "far", "open"],
)
@pytest.mark.parametrize("scale", [1e-120, 1.0, 1e120])
def test_vertex_normals_are_those_by_hand(mesh, scale):
    expected = by_hand(mesh)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    found = mesh_catalog.scaled(mesh, scale).vertex_normals
    # Arc cosines of the reference lose half the digits.
    np.testing.assert_allclose(found, expected, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-15)


def test_symmetric_bodies_have_exact_normals():
    ball = mesh_catalog.icosphere(3)
    assert np.einsum("ij,ij->i", ball.vertex_normals, ball.vertices).min() > np.cos(0.01)
    box = mesh_catalog.box((-1, -1, -1))
    np.testing.assert_allclose(box.vertex_normals, box.vertices / np.sqrt(3), atol=1e-15)
    np.testing.assert_allclose(np.abs(box.face_normals).max(axis=1), 1.0, atol=0)


def test_vertices_and_faces_without_normals_have_zero():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9], [2, 0, 0]]
    mesh = gk.mesh.TriangleMesh(vertices, [[0, 1, 2], [0, 1, 4]])
    assert mesh.face_normals.tolist() == [[0, 0, 1], [0, 0, 0]]
    assert mesh.vertex_normals.tolist() == [[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 0], [0, 0, 0]]
    empty = gk.mesh.TriangleMesh(np.ones((2, 3)), np.zeros((0, 3), int))
    assert empty.vertex_normals.tolist() == [[0, 0, 0]] * 2
    assert empty.face_normals.shape == (0, 3)
    assert (empty.area, empty.volume) == (0.0, 0.0)


@pytest.mark.parametrize("mesh", [mesh_catalog.torus(), mesh_catalog.inside_out_box(), mesh_catalog.open_shell()])
def test_area_and_volume_are_those_of_the_audit(mesh):
    report = gk.mesh.audit(mesh)
    assert (mesh.area, mesh.volume) == (report.area, report.signed_volume)
    a, b, c = (mesh.vertices[corner] for corner in mesh.faces.T)
    assert mesh.area == pytest.approx(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2, rel=1e-12)
