"""Attributes of a mesh: what is taken, what is refused, and that they are part of the mesh."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.mesh import Material, Texture, TriangleMesh
from tests.support.attributed import numbered, painted

BOX = mesh_catalog.box()


def make(**data):
    return TriangleMesh(BOX.vertices, BOX.faces, **data)


def test_arrays_keep_their_type_and_are_read_only():
    given = np.arange(8, dtype=">i2")
    mesh = make(vertex_data={"a": given, "b": [[0.5]] * 8}, corner_data={"c": np.zeros((12, 3), bool)})
    assert mesh.vertex_data["a"].dtype == np.int16
    assert mesh.vertex_data["a"].tolist() == given.tolist()
    assert mesh.vertex_data["b"].shape == (8, 1)
    assert mesh.corner_data["c"].dtype == bool
    assert not mesh.vertex_data["a"].flags.writeable
    with pytest.raises(TypeError):
        mesh.vertex_data["d"] = given


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"vertex_data": {"a": np.zeros(7)}}, r"vertex_data\['a'\]: shape \(7,\) is neither \(8,\) nor \(8, k\)"),
        ({"face_data": {"a": np.zeros((12, 3, 3))}}, r"face_data\['a'\]: shape .* for each of the 12 faces"),
        ({"corner_data": {"a": np.zeros((12, 2))}}, r"corner_data\['a'\]: shape .* neither \(12, 3\) nor \(12, 3, k\)"),
        ({"vertex_data": {"a": np.zeros((8, 0))}}, "holds no numbers"),
        ({"vertex_data": {"a": ["x"] * 8}}, "not a real number type"),
        ({"vertex_data": {" ": np.zeros(8)}}, "not a text"),
        ({"vertex_data": [1]}, "not a mapping"),
        ({"materials": [1]}, r"materials\[0\]: int is not a Material"),
        ({"materials": [Material("a", (1, 2, 3))]}, r"materials\[0\].color: .* is not red, green, blue and alpha"),
        ({"materials": [Material("a", None, "wood.png")]}, "str is not a Texture"),
        ({"materials": [Material("a", None, Texture("wood.png", "x"))]}, "str is not a bytes"),
        ({"materials": [Material("a")], "face_data": {"material": [0] * 11 + [1]}}, "face 11 has 1, but there are 1"),
        ({"face_data": {"material": [-2] * 12}, "materials": [Material("a")]}, "face 0 has -2"),
        ({"meters_per_unit": 0.0}, "meters_per_unit: 0.0 is not a length"),
    ],
)
def test_refused(data, message):
    with pytest.raises(gk.InputError, match=message):
        make(**data)


def test_a_name_means_something_only_with_its_shape():
    mesh = make(vertex_data={"normal": np.zeros(8), "color": np.zeros((8, 2))}, face_data={"material": np.arange(12)})
    assert mesh.face_data["material"].tolist() == list(range(12))


def test_equality_is_of_content():
    one, other = numbered(BOX), numbered(BOX)
    assert one == other
    assert hash(one) == hash(other)
    assert one != BOX
    assert mesh_catalog.box() == BOX
    assert BOX != "box"
    moved = {"vertices": BOX.vertices * 2.0}
    for change in (
        moved,
        {"faces": BOX.faces[:, ::-1]},
        {"name": "other"},
        {"vertex_data": {"v": np.arange(8)}},
        {"vertex_data": {"v": np.arange(8, dtype=np.float32)}},
        {"materials": (Material("x"),)},
        {"meters_per_unit": 1.0},
    ):
        plain = {"vertices": BOX.vertices, "faces": BOX.faces, "name": BOX.name}
        changed = TriangleMesh(**{**plain, **change})
        assert changed != BOX
        assert changed == TriangleMesh(**{**plain, **change})
    assert make(vertex_data={"v": np.arange(8)}) != make(vertex_data={"v": np.arange(8.0)})
    missing = make(vertex_data={"v": np.full(8, np.nan)})
    assert missing == make(vertex_data={"v": np.full(8, np.nan)})


def test_length_is_that_of_the_faces_and_an_empty_mesh_is_true():
    assert len(BOX) == 12
    assert TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda mesh: pickle.loads(pickle.dumps(mesh))])
@pytest.mark.parametrize("make", [numbered, painted, lambda mesh: mesh])
def test_copies_are_equal(again, make):
    mesh = make(BOX)
    copied = again(mesh)
    assert copied == mesh
    assert not any(values.flags.writeable for values in copied.vertex_data.values())


def test_repr_names_them():
    assert repr(numbered(BOX)).endswith("8 vertices, 12 faces, vertex v v2, face f f2, corner c c2, 2 materials)")
    assert repr(Texture("a.png", b"123")) == "Texture('a.png', 3 bytes)"
