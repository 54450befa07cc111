"""Repairs against slow, independent implementations, and their invariances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from benchmarks.catalog import mesh_catalog
from geokit.mesh import TriangleMesh, audit
from geokit.mesh._repair import drop_degenerate, merge_vertices, orient
from tests.support.effort import of_all

TRIANGLES = st.lists(st.lists(st.integers(0, 8), min_size=3, max_size=3, unique=True), min_size=1, max_size=16)
SOLIDS = st.sampled_from([*mesh_catalog.CLOSED, mesh_catalog.inside_out_box])


def random_mesh(faces: list[list[int]], seed: int) -> TriangleMesh:
    return TriangleMesh(np.random.default_rng(seed).normal(size=(9, 3)), faces)


def first_copies(faces: list[list[int]]) -> list[int]:
    seen: dict[frozenset, int] = {}
    return [seen.setdefault(frozenset(face), row) for row, face in enumerate(faces)]


def uses_of_edges(faces: list[list[int]]) -> dict[frozenset, list[tuple[int, bool]]]:
    """For each edge the first copies of faces that use it, and which way."""
    uses: dict[frozenset, list[tuple[int, bool]]] = {}
    for row in sorted(set(first_copies(faces))):
        for k in range(3):
            start, end = faces[row][k], faces[row][(k + 1) % 3]
            uses.setdefault(frozenset((start, end)), []).append((row, start < end))
    return uses


def walked(faces: list[list[int]]) -> list[tuple[dict[int, bool], bool]]:
    """The components, walked face by face: the faces to flip so that the lowest stays, and whether that is
    consistent."""
    pairs = [users for users in uses_of_edges(faces).values() if len(users) == 2]
    pieces: list[tuple[dict[int, bool], bool]] = []
    for first in sorted(set(first_copies(faces))):
        if any(first in turned for turned, _ in pieces):
            continue
        turned, works, grew = {first: False}, True, True
        while grew:
            grew = False
            for (one, way), (other, other_way) in pairs:
                for a, b in ((one, other), (other, one)):
                    if a in turned and b not in turned:
                        turned[b] = turned[a] ^ (way == other_way)
                        grew = True
                if one in turned:
                    works &= turned[one] ^ turned[other] == (way == other_way)
        pieces.append((turned, works))
    return pieces


@pytest.mark.slow
@settings(max_examples=of_all(150, 300), deadline=None)
@given(TRIANGLES, st.integers(0, 1000))
def test_orient_is_the_walk_over_the_faces(faces, seed):
    mesh = random_mesh(faces, seed)
    found = orient(mesh)
    pieces = walked(faces)
    assert found.consistent == all(works for _, works in pieces)
    uses = uses_of_edges(faces)
    for turned, works in pieces:
        rows = list(turned)
        ways = np.array([turned[row] for row in rows])
        if not works:
            assert not found.flipped[rows].any()
            continue
        balance = [
            sum(1 if way ^ turned[row] else -1 for row, way in users if row in turned) for users in uses.values()
        ]
        if any(balance):
            against = int(ways.sum())
            assert np.array_equal(found.flipped[rows], ways ^ (2 * against > len(rows)))
        else:
            # Closed: one of the two windings, and outward unless it is inside other solids.
            assert np.array_equal(found.flipped[rows], ways) or np.array_equal(found.flipped[rows], ~ways)
            if len(pieces) == 1:
                assert np.linalg.det(found.mesh.vertices[found.mesh.faces[rows]]).sum() > 0
    first = first_copies(faces)
    assert np.array_equal(found.flipped, found.flipped[first])
    if len(set(first)) == len(faces):
        assert audit(found.mesh).oriented == found.consistent
    again = orient(found.mesh)
    assert not again.flipped.any()


@settings(max_examples=of_all(20, 40), deadline=None)
@given(SOLIDS, st.integers(0, 1000), st.floats(0.0, 0.4), st.booleans())
def test_solids_come_out_the_same(make, seed, share, reverse):
    mesh = orient(make()).mesh
    rng = np.random.default_rng(seed)
    given_faces = mesh_catalog.with_flips(mesh, share, seed).faces[:, :: -1 if reverse else 1]
    faces, vertices = rng.permutation(len(mesh.faces)), rng.permutation(len(mesh.vertices))
    rank = np.argsort(vertices)
    # The majority of the faces must determine the winding of each nested solid.
    flips = (given_faces != mesh.faces).any(axis=1) ^ reverse
    ranges = [slice(part.first_face, part.first_face + part.face_count) for part in mesh.parts] or [slice(None)]
    assume(all(flips[rows].mean() < 0.5 for rows in ranges))
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    moved = mesh.vertices[vertices] @ rotation.T * 10.0 ** rng.integers(-6, 7) + rng.normal(size=3)
    found = orient(TriangleMesh(moved, rank[given_faces[faces]]))
    assert np.array_equal(found.mesh.faces, rank[mesh.faces[faces]])
    assert found.consistent


@pytest.mark.slow
@settings(max_examples=of_all(100, 200), deadline=None)
@given(st.lists(st.tuples(*[st.integers(-4, 4)] * 3), min_size=1, max_size=40), st.sampled_from([0.5, 1, 1.5, 2.3, 20]))
def test_merging_is_taking_in_order(rows, tolerance):
    points = np.array(rows, np.float64)
    faces = np.random.default_rng(len(rows)).integers(0, len(points), (5, 3))
    kept: list[int] = []
    becomes = []
    for row, point in enumerate(points):
        near = [k for k in kept if np.sum((points[k] - point) ** 2) <= tolerance * tolerance]
        if not near:
            kept.append(row)
        becomes.append(near[0] if near else row)
    merged = merge_vertices(TriangleMesh(points, faces), tolerance=tolerance)
    assert np.array_equal(merged.vertices, points[kept])
    assert np.array_equal(merged.vertices[merged.faces], points[np.array(becomes)[faces]])


@pytest.mark.slow
@settings(max_examples=of_all(50, 100), deadline=None)
@given(st.lists(st.lists(st.integers(0, 5), min_size=3, max_size=3), min_size=1, max_size=20), st.integers(0, 100))
def test_dropping_leaves_what_the_audit_counts(faces, seed):
    mesh = TriangleMesh(np.random.default_rng(seed).normal(size=(6, 3)), faces)
    report = audit(mesh)
    dropped = audit(drop_degenerate(mesh))
    assert dropped.face_count == report.face_count - report.degenerate_count
    assert dropped.degenerate_count == 0
    assert dropped.area == pytest.approx(report.area, rel=1e-14)
    clean = audit(drop_degenerate(mesh, duplicates=True, unreferenced=True))
    assert clean.face_count == dropped.face_count - dropped.duplicate_count
    assert (clean.duplicate_count, clean.unreferenced_count) == (0, 0)
