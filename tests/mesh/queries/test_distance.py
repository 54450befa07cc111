"""Least distance of two surfaces: bodies whose distance is known, and pairs of triangles by hand."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.mesh.queries import distance as distance_module

TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


def surface(mesh):
    return gk.mesh.Surface(mesh, device="cpu")


def of(corners):
    corners = np.asarray(corners, float).reshape(-1, 3)
    return surface(gk.mesh.TriangleMesh(corners, np.arange(len(corners)).reshape(-1, 3)))


def moved(by):
    matrix = np.eye(4)
    matrix[:3, 3] = by
    return matrix


@pytest.mark.parametrize(
    ("other", "distance", "point"),
    [
        ([[0.2, 0.2, 3], [0.3, 0.2, 4], [0.2, 0.3, 4]], 3.0, [0.2, 0.2, 0]),  # a vertex above the face
        ([[0.5, -2, 1], [0.5, -1, 1], [0.5, -1, 9]], 2**0.5, [0.5, 0, 0]),  # a vertex beside an edge
        ([[-3, 0, -4], [-9, 0, -4], [-9, 1, -4]], 5.0, [0, 0, 0]),  # two vertices
        ([[0.5, -1, 1], [0.5, -1, -1], [0.5, -2, 0]], 1.0, [0.5, 0, 0]),  # inside of two edges
        ([[0.2, 0.2, 1], [0.2, 0.2, -1], [0.2, 0.2, -1]], 0.0, [0.2, 0.2, 0]),  # a segment through the face
        ([[1, 0, 0], [2, 0, 5], [2, 1, 5]], 0.0, [1, 0, 0]),  # touching at a vertex
        ([[0.5, 0.5, 2]] * 3, 2.0, [0.5, 0.5, 0]),  # a point
    ],
)
def test_pairs_by_hand(other, distance, point):
    found = of(TRIANGLE).distance(of(other))
    assert found.distance == pytest.approx(distance, abs=1e-15)
    assert found.point == pytest.approx(point, abs=1e-15)
    assert np.linalg.norm(found.point - found.other_point) == pytest.approx(distance, abs=1e-15)
    assert (found.triangle_id, found.other_triangle_id) == (0, 0)


def test_boxes_a_gap_apart_whatever_the_place():
    near, far = gk.mesh.box((1, 1, 1)), gk.mesh.box((2, 2, 2), center=(1.5 + 2**-20, 0, 0))
    for offset in (0.0, 2.0**20):
        ends = [surface(mesh_catalog.moved(mesh, (offset, -offset, offset))) for mesh in (near, far)]
        assert ends[0].distance(ends[1]).distance == 2**-20
        assert ends[1].distance(ends[0]).distance == 2**-20


def test_spheres_against_the_formula():
    # A vertex of each lies on the line of centers: the poles.
    low, high = (surface(gk.mesh.sphere(1.0, segments=96, center=(0, 0, z))) for z in (0.0, 5.0))
    found = low.distance(high)
    assert found.distance == pytest.approx(3.0, abs=1e-14)
    assert found.point == pytest.approx([0, 0, 1], abs=1e-14)
    assert found.other_point == pytest.approx([0, 0, 4], abs=1e-14)


def test_a_body_inside_another_is_away_from_its_surface():
    inner, outer = surface(gk.mesh.box((1, 1, 1))), surface(gk.mesh.box((4, 4, 4)))
    assert inner.distance(outer).distance == 1.5


def test_itself():
    torus = surface(mesh_catalog.torus())
    assert torus.distance(torus).distance == 0.0
    assert torus.distance(torus)[3:] == (0, 0)


def test_transform_moves_this_surface():
    one, other = surface(gk.mesh.box((1, 1, 1))), surface(gk.mesh.box((1, 1, 1), center=(5, 0, 0)))
    found = one.distance(other, transform=moved([1.0, 0, 0]))
    assert found.distance == 3.0
    assert (found.point[0], found.other_point[0]) == (1.5, 4.5)
    assert other.distance(one, transform=moved([1.0, 0, 0])).distance == 5.0
    # A part of any size, sheared and flattened: the map need not be rigid.
    flat = np.diag([2.0, 3.0, 0.0, 1.0])
    assert one.distance(other, transform=flat).distance == 3.5


@pytest.mark.parametrize("rows", [1 << 22, 40])
def test_many_poses_have_the_bits_of_one(rows, monkeypatch):
    """Apart, touching and intersecting, turned, sheared and mirrored; in one block of poses and in several."""
    monkeypatch.setattr(distance_module, "ROWS", rows)
    rng = np.random.default_rng(5)
    maps = np.tile(np.eye(4), (60, 1, 1))
    maps[:, :3, :3] = np.linalg.qr(rng.normal(size=(60, 3, 3)))[0]
    maps[::7, :3, :3] *= rng.uniform(0.1, 3.0, (len(maps[::7]), 1, 3))
    maps[:, :3, 3] = rng.uniform(-3.0, 3.0, (60, 3))
    maps[3] = moved([2.0, 0, 0])
    for mesh, another in (
        (mesh_catalog.torus(), gk.mesh.box((2, 2, 2))),
        (gk.mesh.box((2, 2, 2)), gk.mesh.box((2, 2, 2))),
    ):
        one, other = surface(mesh), surface(another)
        found = one.distance(other, transform=maps)
        assert {(found.distance == 0.0).any(), (found.distance > 0.0).any()} == {True}
        each = [one.distance(other, transform=map) for map in maps]
        for field in found._fields:
            np.testing.assert_array_equal(getattr(found, field), np.array([getattr(single, field) for single in each]))
        # Pairs that slabs and bounds leave out are no nearer: vertices of either are as far as that or farther.
        for map, least in zip(maps[:20], found.distance[:20], strict=True):
            placed = mesh.vertices @ map[:3, :3].T + map[:3, 3]
            assert other.closest_point(placed).distance.min() >= least * (1 - 1e-12) - 1e-15


def test_no_poses_and_one():
    one, other = surface(gk.mesh.box((1, 1, 1))), surface(gk.mesh.box((1, 1, 1), center=(5, 0, 0)))
    none = one.distance(other, transform=np.zeros((0, 4, 4)))
    assert [np.shape(field) for field in none] == [(0,), (0, 3), (0, 3), (0,), (0,)]
    assert one.distance(other, transform=moved([1.0, 0, 0])[None]).distance.tolist() == [3.0]


def test_meets_exactly_where_triangles_intersect():
    """One rounding apart is apart, and one rounding in is in."""
    one, other = surface(gk.mesh.box((2, 2, 2))), surface(gk.mesh.box((2, 2, 2)))
    assert one.distance(other, transform=moved([2.0, 0, 0])).distance == 0.0
    assert one.distance(other, transform=moved([np.nextafter(2.0, 3), 0, 0])).distance > 0.0
    assert one.distance(other, transform=moved([np.nextafter(2.0, 1), 0, 0])).distance == 0.0


def test_far_and_near_nothing_is_missed():
    """Bodies a million sizes apart, or of very different sizes."""
    small = gk.mesh.sphere(1.0, segments=24)
    for scale, away in ((1.0, 1e6), (1e-6, 1.0), (1e6, 3e6)):
        body = mesh_catalog.moved(mesh_catalog.scaled(small, scale), (2.0 * scale + away, 0, 0))
        reference = surface(small).closest_point(body.vertices)
        found = surface(body).distance(surface(small)).distance
        assert found <= reference.distance.min() * (1 + 1e-12)
        assert found == pytest.approx(surface(small).distance(surface(body)).distance, rel=1e-12)


@pytest.mark.parametrize("scale", [2.0**-200, 2.0**-40, 2.0**40, 2.0**200])
def test_scale_by_a_power_of_two_changes_no_digit(scale):
    torus, ball = mesh_catalog.torus(), gk.mesh.sphere(0.3, segments=24, center=(1.7, 0.2, 0.4))
    expected = surface(ball).distance(surface(torus))
    found = surface(mesh_catalog.scaled(ball, scale)).distance(surface(mesh_catalog.scaled(torus, scale)))
    assert found.distance == scale * expected.distance
    assert np.array_equal(found.point, scale * expected.point)
    assert found[3:] == expected[3:]


def test_updated_surfaces():
    up = np.array([0.0, 0, 1])
    one, other = of(TRIANGLE), of(TRIANGLE + 2 * up)
    other.update(TRIANGLE + 7 * up)
    assert one.distance(other).distance == 7.0


@pytest.mark.parametrize(
    ("transform", "message"),
    [
        (np.eye(3), r"transform: shape \(3, 3\)"),
        (np.full((4, 4), np.nan), "transform: .*not finite"),
        (2.0 * np.eye(4), "transform: the last row"),
        (moved([1e200, 0, 0]), "transform: it moves a corner beyond"),
        (np.stack([np.eye(4), moved([1e200, 0, 0])]), "transform: map 1 moves a corner beyond"),
        (np.stack([np.eye(4), 2.0 * np.eye(4)]), "transform: map 1 is .*0, 0, 0, 1 in the last row"),
        (np.stack([np.eye(4), moved([np.inf, 0, 0])]), "transform: map 1 is .*finite"),
        (np.zeros((2, 3, 4)), r"transform: shape \(2, 3, 4\) is not"),
    ],
)
def test_refuses_maps(transform, message):
    with pytest.raises(gk.errors.InputError, match=message):
        of(TRIANGLE).distance(of(TRIANGLE), transform=transform)


def test_refuses_what_is_no_surface():
    with pytest.raises(gk.errors.InputError, match="other: TriangleMesh is not a Surface"):
        of(TRIANGLE).distance(mesh_catalog.tetrahedron())
    tiny = surface(mesh_catalog.scaled(mesh_catalog.tetrahedron(), 1e-80))
    for one, other in ((tiny, of(TRIANGLE)), (of(TRIANGLE), tiny)):
        with pytest.raises(gk.errors.InputError, match="across; scale it"):
            one.distance(other)
