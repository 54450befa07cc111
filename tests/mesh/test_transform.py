"""Affine maps of meshes: positions, winding, normals and attributes."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from tests.support.attributed import numbered

TORUS = mesh_catalog.torus(12, 8)


def affine(linear, offset=(0.0, 0.0, 0.0)):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, offset
    return matrix


@pytest.mark.parametrize("seed", range(6))
def test_normals_of_the_moved_mesh_are_the_moved_normals(seed):
    random = np.random.default_rng(seed)
    linear = random.normal(size=(3, 3))
    mesh = gk.mesh.TriangleMesh(
        TORUS.vertices, TORUS.faces, face_data={"normal": TORUS.face_normals, "row": np.arange(len(TORUS))},
        corner_data={"corner": np.arange(3 * len(TORUS)).reshape(-1, 3)}, meters_per_unit=0.1,
    )  # fmt: skip
    moved = mesh.transform(affine(linear, (1, 2, 3)))
    np.testing.assert_allclose(moved.vertices, TORUS.vertices @ linear.T + [1, 2, 3], atol=1e-14)
    np.testing.assert_allclose(moved.face_data["normal"], moved.face_normals, atol=1e-12)
    assert moved.volume == pytest.approx(TORUS.volume * abs(np.linalg.det(linear)), rel=1e-9)
    mirrored = np.linalg.det(linear) < 0
    order = slice(None, None, -1 if mirrored else 1)
    np.testing.assert_array_equal(moved.faces, TORUS.faces[:, order])
    np.testing.assert_array_equal(moved.corner_data["corner"], mesh.corner_data["corner"][:, order])
    assert moved.meters_per_unit == 0.1
    assert {np.linalg.det(np.random.default_rng(s).normal(size=(3, 3))) < 0 for s in range(6)} == {True, False}


def test_other_attributes_and_parts_stay():
    mesh = numbered(mesh_catalog.join(mesh_catalog.box(), mesh_catalog.tetrahedron()))
    assert gk.mesh.transform(mesh, np.eye(4)) == mesh
    moved = mesh.transform(affine(-2.0 * np.eye(3)))
    assert (moved.parts, moved.materials, moved.name) == (mesh.parts, mesh.materials, mesh.name)
    np.testing.assert_array_equal(moved.face_data["f2"], mesh.face_data["f2"])
    np.testing.assert_array_equal(moved.corner_data["c2"], mesh.corner_data["c2"][:, ::-1])


@pytest.mark.parametrize("scale", [1e-150, 1e150])
def test_extreme_scales(scale):
    mirrored = TORUS.transform(affine(scale * np.diag([1, 1, -1])))
    np.testing.assert_array_equal(mirrored.faces, TORUS.faces[:, ::-1])
    assert np.isfinite(mirrored.vertices).all()


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), r"matrix: shape \(3, 3\) is not \(4, 4\)"),
        (np.full((4, 4), np.nan), "not finite"),
        (2.0 * np.eye(4), r"matrix: the last row is \[0.0, 0.0, 0.0, 2.0\]"),
        (affine(1.5e308 * np.eye(3)), "leaves the range of float64"),
    ],
)
def test_refused(matrix, message):
    with pytest.raises(gk.InputError, match=message):
        TORUS.transform(matrix)
