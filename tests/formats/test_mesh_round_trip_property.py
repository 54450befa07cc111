"""What is saved is what is loaded, for any mesh; polygons are cut without loss; the audit sees the geometry only."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import geokit as gk
from geokit.core.equal_rows import merge_equal_points, merge_equal_rows
from geokit.formats.polygons import triangulate
from geokit.mesh import TriangleMesh
from tests.support.effort import of_all

FINITE = st.floats(allow_nan=False, allow_infinity=False)
FLOAT32 = st.floats(allow_nan=False, allow_infinity=False, width=32)


@st.composite
def meshes(draw, numbers=FINITE) -> TriangleMesh:
    count = draw(st.integers(1, 12))
    vertices = draw(st.lists(st.tuples(numbers, numbers, numbers), min_size=count, max_size=count))
    index = st.integers(0, count - 1)
    faces = draw(st.lists(st.tuples(index, index, index), min_size=1, max_size=20))
    return TriangleMesh(np.array(vertices), np.array(faces))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [".obj", ".off", ".ply"])
@settings(max_examples=of_all(15, 60), deadline=None)
@given(mesh=meshes())
def test_every_bit_returns(kind, mesh):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"mesh{kind}"
        gk.mesh.save(path, mesh)
        again = gk.mesh.load(path)
    assert again.vertices.tobytes() == mesh.vertices.tobytes()
    assert again.faces.tobytes() == mesh.faces.tobytes()


@pytest.mark.slow
@settings(max_examples=of_all(15, 60), deadline=None)
@given(mesh=meshes(FLOAT32))
def test_stl_keeps_the_corners_and_merges_equal_ones(mesh):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.stl"
        gk.mesh.save(path, mesh)
        again = gk.mesh.load(path)
    np.testing.assert_array_equal(again.vertices[again.faces], mesh.vertices[mesh.faces])
    # Adding zero makes -0.0 and 0.0 one position.
    assert len(again.vertices) == len(np.unique(mesh.vertices[mesh.faces].reshape(-1, 3) + 0.0, axis=0))


@settings(max_examples=of_all(25, 100), deadline=None)
@given(st.lists(st.tuples(*[st.integers(-3, 3)] * 3), max_size=40))
def test_merging_rows_is_the_slow_way_done_fast(rows):
    table = np.array(rows, np.int64).reshape(-1, 3)
    first, group = merge_equal_rows(table)
    seen: dict[tuple[int, ...], int] = {}
    expected = [seen.setdefault(row, len(seen)) for row in rows]
    assert group.tolist() == expected
    assert first.tolist() == [expected.index(number) for number in range(len(seen))]


def test_merging_survives_equal_hashes(monkeypatch):
    from geokit.core import equal_rows

    # With these constants only the first column counts: all hashes collide.
    monkeypatch.setattr(equal_rows, "_MIX", np.array([1, 0, 0], np.uint64))
    rows = np.array([[1, 2, 3], [1, 3, 2], [1, 2, 3], [1, 0, 0], [1, 3, 2]])
    first, group = merge_equal_rows(rows)
    assert (first.tolist(), group.tolist()) == ([0, 1, 3], [0, 1, 0, 2, 1])


def test_merging_points_tells_neighbors_apart():
    points = np.array([[1.0, 0, 0], [np.nextafter(1.0, 2), 0, 0], [1.0, -0.0, 0]])
    assert merge_equal_points(points)[1].tolist() == [0, 1, 0]


@settings(max_examples=of_all(15, 60), deadline=None)
@given(st.lists(st.integers(3, 8), min_size=1, max_size=6), st.integers(0, 2**32 - 1))
def test_star_polygons_are_covered_once(sizes, seed):
    # Star-shaped outlines around the origin, at random radii: simple, and mostly concave.
    random = np.random.default_rng(seed)
    outlines = []
    for size in sizes:
        angle = 2 * np.pi * (np.arange(size) + random.uniform(-0.3, 0.3, size)) / size
        outlines.append((random.uniform(0.3, 1.0, size) * [np.cos(angle), np.sin(angle)]).T)
    flat = np.concatenate(outlines)
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    points = np.c_[flat, np.zeros(len(flat))] @ rotation.T
    faces, polygon = triangulate(points, np.array(sizes), np.arange(len(flat)))
    a, b, c = (flat[faces[:, corner]] for corner in range(3))
    areas = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    assert (areas > -1e-12).all()
    for number, outline in enumerate(outlines):
        x, y = outline.T
        expected = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2
        assert areas[polygon == number].sum() == pytest.approx(expected, rel=1e-12)


@settings(max_examples=of_all(15, 60), deadline=None)
@given(meshes(st.integers(-2, 2).map(float)), st.integers(0, 2**32 - 1))
def test_audit_does_not_depend_on_numbering(mesh, seed):
    random = np.random.default_rng(seed)
    order = random.permutation(len(mesh.vertices))
    faces = np.argsort(order)[mesh.faces][random.permutation(len(mesh.faces))]
    rolls = random.integers(0, 3, len(faces))
    faces = np.take_along_axis(faces, (rolls[:, None] + np.arange(3)) % 3, axis=1)
    one, other = gk.mesh.audit(mesh), gk.mesh.audit(TriangleMesh(mesh.vertices[order], faces))
    for name, value in vars(one).items():
        if value is None:  # not asked for
            continue
        np.testing.assert_allclose(getattr(other, name), value, rtol=1e-12, atol=1e-12, err_msg=name)
