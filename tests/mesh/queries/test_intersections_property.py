"""Pairs of triangles on a small lattice, where nearly every arrangement is degenerate: exact, against rationals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import geokit as gk
from tests.support import reference
from tests.support.effort import of_all

pytestmark = pytest.mark.slow

# On lattices this small most triangles touch, share corners, lie in one plane or have no area.
LATTICE = st.lists(st.tuples(*[st.integers(0, 3)] * 3), min_size=6, max_size=21).filter(lambda p: len(set(p)) > 1)


def triangles(points):
    return np.array(points[: len(points) // 3 * 3], float).reshape(-1, 3, 3)


def surface(corners):
    mesh = gk.mesh.TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    return gk.mesh.Surface(mesh, device="cpu")


@settings(max_examples=of_all(40, 150), deadline=None)
@given(LATTICE)
def test_self_intersections_on_a_lattice(points):
    corners = triangles(points)
    expected = reference.intersecting_pairs(corners)
    assert surface(corners).self_intersections().tolist() == expected
    assert surface(corners)._has_self_intersections() == bool(expected)


@settings(max_examples=of_all(25, 100), deadline=None)
@given(LATTICE, LATTICE)
def test_intersecting_triangles_on_a_lattice(points, others):
    one, other = triangles(points), triangles(others)
    expected = reference.intersecting_pairs(one, other)
    assert surface(one).intersecting_triangles(surface(other)).tolist() == expected


@settings(max_examples=of_all(25, 100), deadline=None)
@given(LATTICE, st.integers(0, 10_000))
def test_moved_by_one_rounding(points, seed):
    """The lattice rotated and moved, each coordinate off by some last bits: nearly degenerate everywhere, never
    exactly."""
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    corners = triangles(points) @ rotation + rng.choice([0.0, 1.0, 1e6])
    expected = reference.intersecting_pairs(corners)
    assert surface(corners).self_intersections().tolist() == expected
