"""Faces back to back in the audit: pairs of the same three positions with opposite windings."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.mesh import TriangleMesh


@pytest.mark.parametrize(
    "make", [mesh_catalog.box, mesh_catalog.torus, mesh_catalog.open_shell], ids=lambda f: f.__name__
)
def test_each_doubled_face_is_a_pair(make):
    mesh = make()
    for some in (slice(0, 0), slice(0, 1), slice(2, 7), slice(None)):
        report = gk.mesh.audit(mesh_catalog.doubled(mesh, some))
        count = len(mesh.faces[some])
        assert (report.back_to_back_count, report.duplicate_count) == (count, count)


def test_positions_count_and_not_indices():
    mesh = mesh_catalog.soup(mesh_catalog.doubled(mesh_catalog.torus()))
    rolled = TriangleMesh(mesh.vertices, np.roll(mesh.faces, 1, axis=1))
    assert gk.mesh.audit(rolled).back_to_back_count == len(mesh_catalog.torus().faces)


@pytest.mark.parametrize(
    ("faces", "pairs"),
    [
        ([[0, 1, 2], [1, 2, 0]], 0),
        ([[0, 1, 2], [2, 1, 0]], 1),
        ([[0, 1, 2], [2, 1, 0], [0, 1, 2]], 1),
        ([[2, 1, 0], [0, 1, 2], [1, 2, 0], [0, 2, 1]], 2),
        # No side is that of a face with two equal corners.
        ([[0, 1, 1], [1, 1, 0], [1, 0, 1]], 0),
        ([[0, 1, 2], [2, 1, 3]], 0),
    ],
)
def test_copies_count_by_direction(faces, pairs):
    mesh = TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], faces)
    assert gk.mesh.audit(mesh).back_to_back_count == pairs


def test_drop_degenerate_leaves_one_of_two():
    mesh = mesh_catalog.torus()
    single = gk.mesh.drop_degenerate(mesh_catalog.doubled(mesh), duplicates=True)
    np.testing.assert_array_equal(single.faces, mesh.faces)
