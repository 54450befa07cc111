"""Differences and intersections of random bodies against the winding numbers of each, at random points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import geokit as gk
from geokit.mesh import TriangleMesh, box, cylinder, difference, intersection, sphere, torus, union
from tests.support.assemblies import concatenated, turned
from tests.support.effort import of_all

# Bodies of each of two or three meshes: what they are, and how they lie.
MESH = st.lists(st.tuples(st.sampled_from("bscth"), st.integers(0, 10**6)), min_size=1, max_size=3)
MESHES = st.lists(MESH, min_size=2, max_size=3)
POINTS = 100_000


def body(kind: str, seed: int) -> TriangleMesh:
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.4, 1.0)
    made = {
        "b": lambda: box(size * rng.uniform(0.5, 1.5, 3)),
        "s": lambda: sphere(size, segments=10),
        "c": lambda: cylinder(0.5 * size, 2.0 * size, segments=11),
        "t": lambda: torus(size, 0.3 * size, segments=12, tube_segments=7),
        "h": lambda: difference(sphere(size, segments=12), turned(box((0.6 * size,) * 3), seed + 1)),
    }[kind]()
    return turned(made, seed, rng.uniform(-0.5, 0.5))


def inside(mesh: TriangleMesh, points: np.ndarray) -> np.ndarray:
    if not mesh.face_count:
        return np.zeros(len(points), bool)
    return gk.mesh.Surface(mesh, device="cpu").winding_number(points) > 0.5


def apart(meshes: Sequence[TriangleMesh], points: np.ndarray) -> np.ndarray:
    """Points that are not within the tolerance of winding numbers of a surface."""
    each = [gk.mesh.Surface(mesh, device="cpu").closest_point(points, max_distance=1e-4).distance for mesh in meshes]
    return np.min(each, axis=0) > 1e-5


@pytest.mark.slow
@settings(max_examples=of_all(15, 100), deadline=None)
@example([[("t", 1), ("t", 2)], [("h", 3)]])
@example([[("h", 5)], [("h", 5)], [("b", 7)]])
@given(meshes=MESHES)
def test_inside_is_what_the_verb_says(meshes: list[list[tuple[str, int]]]) -> None:
    # Bodies of a mesh may overlap: it is what they enclose together.
    first, *others = (concatenated(*(body(*shape) for shape in mesh)) for mesh in meshes)
    points = np.random.default_rng(1).uniform(-1.6, 1.6, (POINTS, 3))
    points = points[apart([first, *others], points)]
    in_first, in_others = inside(first, points), [inside(other, points) for other in others]
    left, common = difference(first, *others), intersection(first, *others)
    np.testing.assert_array_equal(inside(left, points), in_first & ~np.any(in_others, axis=0))
    np.testing.assert_array_equal(inside(common, points), in_first & np.all(in_others, axis=0))


@pytest.mark.slow
@settings(max_examples=of_all(15, 100), deadline=None)
@given(one=MESH, other=MESH)
def test_what_is_alone_and_what_is_common_make_the_whole(one: list, other: list) -> None:
    a, b = (union(concatenated(*(body(*shape) for shape in mesh))) for mesh in (one, other))
    alone, common, both = difference(a, b), intersection(a, b), union(a, b)
    assert alone.volume + common.volume == pytest.approx(a.volume, rel=1e-9)
    assert both.volume == pytest.approx(a.volume + b.volume - common.volume, rel=1e-9)
    assert both.area + common.area == pytest.approx(a.area + b.area, rel=1e-9)
    again = union(alone, common) if alone.face_count and common.face_count else a
    assert again.volume == pytest.approx(a.volume, rel=1e-6)
    assert difference(a, a).face_count == 0
    assert intersection(a, a).volume == pytest.approx(a.volume, rel=1e-9)
