"""Least distance of two surfaces: pairs against exact rationals, soups against all pairs, what must not change it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import geokit as gk
from benchmarks.catalog import mesh_catalog
from tests.support import reference
from tests.support.effort import of_all

pytestmark = pytest.mark.slow

# On lattices this small most triangles touch, are parallel, lie in one plane or have no area.
CORNERS = st.lists(st.tuples(*[st.integers(0, 3)] * 3), min_size=3, max_size=3)
SOUP = st.lists(CORNERS, min_size=1, max_size=5)
SEED = st.integers(0, 2**32 - 1)
# Relative to the size of the two.
ERROR = 1e-12


def surface(corners):
    corners = np.asarray(corners, float)
    mesh = gk.mesh.TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    return gk.mesh.Surface(mesh, device="cpu")


def check(t, u):
    found = surface(t).distance(surface(u))
    table = np.array([[math.sqrt(reference.squared_triangle_distance(a, b)) for b in u] for a in t])
    least, size = table.min(), np.ptp(np.concatenate([t, u]).reshape(-1, 3), axis=0).max() or 1.0
    assert abs(found.distance - least) <= ERROR * size
    assert (found.distance == 0.0) == (least == 0.0)
    # The witnesses lie on their triangles, that far apart.
    away = np.linalg.norm(found.point - found.other_point)
    scale = size + np.abs(np.concatenate([t, u])).max() * 1e-3
    assert abs(away - found.distance) <= ERROR * scale
    for corners, point, row in ((t, found.point, found.triangle_id), (u, found.other_point, found.other_triangle_id)):
        on = reference.squared_triangle_distance(corners[row], np.tile(point, (3, 1)))
        assert math.sqrt(on) <= ERROR * scale
    assert table[found.triangle_id, found.other_triangle_id] <= least + ERROR * size
    return table, found


@settings(max_examples=of_all(20, 80), deadline=None)
@given(SOUP, SOUP, st.tuples(*[st.integers(-4, 4)] * 3))
def test_lattice_soups(one, other, offset):
    t, u = np.array(one, float), np.array(other, float) + offset
    if min(np.ptp(x.reshape(-1, 3), axis=0).max() for x in (t, u)) == 0.0:
        return
    table, found = check(t, u)
    if table.min() == 0.0:  # ties are exact there, and the lowest pair wins
        assert [found.triangle_id, found.other_triangle_id] == np.argwhere(table == 0.0)[0].tolist()


@settings(max_examples=of_all(20, 80), deadline=None)
@given(SEED, st.sampled_from([1.0, 1e-3, 1e-6, 1e-9, 1e-12]), st.sampled_from([0.0, 1.0, 1e4]))
def test_nearly_parallel_edges_and_slivers(seed, tilt, far):
    """Edges that cross at a small angle and triangles that are that thin, also far from the origin."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=3)
    side = np.cross(d, rng.normal(size=3))
    t, u = np.zeros((1, 3, 3)), np.zeros((1, 3, 3))
    for corners, turn in ((t, 1.0), (u, -1.0)):
        start = rng.normal(size=3) * 0.3
        corners[0] = [
            start,
            start + d + turn * tilt * side,
            start + 0.5 * d + rng.choice([tilt, 1.0]) * rng.normal(size=3),
        ]
    u += rng.choice([0.0, 1e-6, 1.0]) * rng.normal(size=3)
    check(t + far, u + far)


@settings(max_examples=of_all(10, 40), deadline=None)
@given(SEED)
def test_random_soups(seed):
    rng = np.random.default_rng(seed)
    t, u = (rng.normal(size=(rng.integers(1, 6), 1, 3)) + 0.3 * rng.normal(size=(1, 3, 3)) for _ in range(2))
    check(t, u + rng.choice([0.0, 1.0, 5.0]) * rng.normal(size=3))


@pytest.mark.parametrize("pair", [("torus", "icosphere"), ("torus", "box"), ("open_shell", "sliver_fan")])
@pytest.mark.parametrize("away", [0.3, 3.0, 300.0])
def test_no_pair_is_missed_by_the_tree(pair, away):
    """Dense samples of either are nowhere nearer to the other, and other trees over the same bodies agree."""
    one, other = (getattr(mesh_catalog, name)() for name in pair)
    matrix = np.eye(4)
    matrix[:3, :3] = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    matrix[:3, 3] = [0.2, away + 0.5, 0.1]
    first, second = gk.mesh.Surface(one, device="cpu"), gk.mesh.Surface(other, device="cpu")
    found = first.distance(second, transform=matrix)
    placed = gk.mesh.transform(one, matrix)
    ends = [gk.mesh.Surface(placed, device="cpu"), second]
    for mesh, target in ((placed, ends[1]), (other, ends[0])):
        samples = np.concatenate([mesh.vertices, gk.mesh.sample_surface(mesh, 20_000, seed=1).points])
        nearest = target.closest_point(samples).distance.min()
        assert nearest >= found.distance - 1e-12 * (1.0 + away)
    by_meets = len(ends[0].intersecting_triangles(second)) > 0
    assert (found.distance == 0.0) == by_meets
    assert found.distance == pytest.approx(ends[0].distance(second).distance, rel=1e-12, abs=1e-13)
    back = second.distance(ends[0])
    assert back.distance == pytest.approx(found.distance, rel=1e-12, abs=1e-13)


@settings(max_examples=of_all(10, 40), deadline=None)
@given(SEED)
def test_order_of_faces_changes_no_distance(seed):
    rng = np.random.default_rng(seed)
    t, u = (rng.integers(0, 6, size=(30, 3, 3)).astype(float) for _ in range(2))
    u += [rng.choice([0, 9]), 0, 0]
    expected = surface(t).distance(surface(u))
    a, b = rng.permutation(30), rng.permutation(30)
    assert surface(t[a]).distance(surface(u[b])).distance == expected.distance
