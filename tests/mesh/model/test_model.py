"""TriangleMesh: its stored arrays, its errors, and the names of the package."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.mesh import MeshPart, TriangleMesh

POINTS = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def test_arrays_are_float64_and_int32_and_read_only():
    mesh = TriangleMesh(np.array(POINTS, np.float32), np.array([[0, 1, 2]], np.uint8), name="t")
    assert (mesh.vertices.dtype, mesh.faces.dtype) == (np.float64, np.int32)
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0, 0] = 1
    with pytest.raises(ValueError, match="read-only"):
        mesh.faces[0, 0] = 1
    assert repr(mesh) == "TriangleMesh('t', 3 vertices, 1 faces)"


def test_the_callers_arrays_stay_writable():
    vertices, faces = np.array(POINTS, np.float64), np.array([[0, 1, 2]], np.int32)
    TriangleMesh(vertices, faces)
    vertices[0, 0] = 5.0
    faces[0, 0] = 1


def test_parts_are_kept():
    part = MeshPart("a", 0, 1)
    assert TriangleMesh(POINTS, [[0, 1, 2]], parts=(part,)).parts == (part,)


def test_bounds_are_those_of_used_vertices():
    mesh = mesh_catalog.unreferenced_vertices()
    assert mesh.bounds.tolist() == [[0, 0, 0], [1, 1, 1]]
    assert mesh.diagonal == np.sqrt(3.0)
    empty = TriangleMesh(POINTS, np.zeros((0, 3), int))
    assert np.isnan(empty.bounds).all()
    assert np.isnan(empty.diagonal)


BAD = [
    ([[0, 0], [1, 1]], [[0, 1, 0]], r"vertices: shape \(2, 2\)"),
    (POINTS, [[0, 1]], r"faces: shape \(1, 2\)"),
    (POINTS, [0, 1, 2], r"faces: shape \(3,\)"),
    (POINTS, [[0, 1, 2], [0, 1, 3]], r"faces: row 1 is \[0, 1, 3\], outside the 3 vertices"),
    (POINTS, [[0, 1, -1]], "faces: row 0"),
    (POINTS, [[0, 1, 2**31]], "faces: row 0"),
    (POINTS, np.array([[0, 1, 2**63]], np.uint64), "faces: row 0"),
    (POINTS, [[0.0, 1.0, 2.0]], "faces: dtype float64"),
    ([[0, 0, 0], [0, np.nan, 0], [np.inf, 0, 0]], [[0, 1, 2]], "vertices: row 1 is not finite"),
    ([["a", 0, 0]], np.zeros((0, 3), int), "vertices: dtype .* is not a real number type"),
]


@pytest.mark.parametrize(("vertices", "faces", "message"), BAD, ids=range(len(BAD)))
def test_bad_input_is_named(vertices, faces, message):
    with pytest.raises(gk.InputError, match=message):
        TriangleMesh(vertices, faces)


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="nonsense"):
        gk.mesh.nonsense  # noqa: B018
    assert sorted(dir(gk.mesh)) == sorted(gk.mesh.__all__)


def test_every_public_name_is_found():
    for name in gk.mesh.__all__:
        assert getattr(gk.mesh, name).__name__ == name
