"""Pieces of meshes: components, parts, materials, and the largest of them."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.mesh import keep_largest, split
from tests.support.attributed import numbered, painted


def three():
    """A small box, a torus and a tetrahedron, with a vertex that nothing uses between them."""
    small = mesh_catalog.moved(mesh_catalog.scaled(mesh_catalog.box(), 0.01), (9, 0, 0))
    far = mesh_catalog.moved(mesh_catalog.tetrahedron(), (-9, 0, 0))
    return numbered(mesh_catalog.join(small, mesh_catalog.torus(12, 6), far))


def test_components_are_the_bodies_with_their_attributes():
    mesh = three()
    pieces = split(mesh)
    assert [len(piece) for piece in pieces] == [12, 144, 4]
    assert sum(piece.vertex_count for piece in pieces) == mesh.vertex_count
    first = 0
    for piece in pieces:
        rows = slice(first, first + len(piece))
        np.testing.assert_array_equal(piece.vertices[piece.faces], mesh.vertices[mesh.faces[rows]])
        np.testing.assert_array_equal(piece.vertices, mesh.vertices[piece.vertex_data["v"]])
        np.testing.assert_array_equal(piece.face_data["f"], mesh.face_data["f"][rows])
        np.testing.assert_array_equal(piece.corner_data["c2"], mesh.corner_data["c2"][rows])
        assert (piece.materials, piece.meters_per_unit, piece.parts) == (mesh.materials, 0.001, ())
        first += len(piece)


def test_mixed_order_of_faces():
    mesh = three()
    order = np.random.default_rng(0).permutation(len(mesh))
    shuffled = gk.mesh.TriangleMesh(mesh.vertices, mesh.faces[order], face_data={"row": np.arange(len(mesh))})
    pieces = split(shuffled)
    assert sorted(len(piece) for piece in pieces) == [4, 12, 144]
    rows = [piece.face_data["row"] for piece in pieces]
    assert all((np.diff(row) > 0).all() for row in rows)
    assert [row[0] for row in rows] == sorted(row[0] for row in rows)


def test_components_are_those_of_the_audit():
    for mesh in (mesh_catalog.soup(mesh_catalog.nested_boxes()), mesh_catalog.two_boxes_touching_at_a_vertex()):
        assert len(split(mesh)) == gk.mesh.audit(mesh).component_count


def test_parts_and_materials():
    mesh = mesh_catalog.join(mesh_catalog.box(), mesh_catalog.tetrahedron())
    assert [(piece.name, len(piece)) for piece in split(mesh, by="parts")] == [("box", 12), ("tetrahedron", 4)]
    box = painted(mesh_catalog.box())
    assert [(piece.name, len(piece)) for piece in split(box, by="materials")] == [("red", 6), ("wood", 6)]
    some = gk.mesh.TriangleMesh(**{**vars(box), "face_data": {"material": [1, -1] * 6}})
    assert [piece.name for piece in split(some, by="materials")] == ["wood", ""]
    assert split(mesh_catalog.box(), by="parts") == split(mesh_catalog.box(), by="materials") == [mesh_catalog.box()]


@pytest.mark.parametrize("by", ["components", "parts", "materials"])
def test_an_empty_mesh_has_no_pieces(by):
    assert split(gk.mesh.TriangleMesh(np.zeros((2, 3)), np.zeros((0, 3), int)), by=by) == []


def test_the_largest_stay():
    mesh = three()
    assert [len(keep_largest(mesh, count)) for count in (1, 2, 3, 9)] == [144, 148, 160, 160]
    assert keep_largest(mesh, 3) is mesh
    largest = keep_largest(mesh)
    np.testing.assert_array_equal(largest.face_data["f2"], mesh.face_data["f2"][12:156])
    assert [(part.name, part.face_count) for part in largest.parts] == [("box", 0), ("torus", 144), ("tetrahedron", 0)]
    assert len(keep_largest(mesh, share=0.0)) == 160
    assert len(keep_largest(mesh, share=1e-3)) == 148
    assert len(keep_largest(mesh, share=1.0)) == 144
    twins = mesh_catalog.join(mesh_catalog.box(), mesh_catalog.moved(mesh_catalog.box(), (5, 0, 0)))
    assert keep_largest(twins).bounds.tolist() == mesh_catalog.box().bounds.tolist()
    empty = gk.mesh.TriangleMesh(np.zeros((2, 3)), np.zeros((0, 3), int))
    assert keep_largest(empty) is empty


def test_refused():
    with pytest.raises(gk.InputError, match="by: 'colors' is not known"):
        split(three(), by="colors")
    with pytest.raises(gk.InputError, match="count: 0 is not a whole number"):
        keep_largest(three(), 0)
    with pytest.raises(gk.InputError, match="share: 2 is not from 0 to 1"):
        keep_largest(three(), share=2.0)
