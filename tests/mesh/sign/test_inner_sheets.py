"""Signs of closed bodies with open sheets inside: decks, ribs and partitions do not say what is inside."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.mesh import Surface, TriangleMesh
from tests.mesh.sign.test_left_out import SIGNS, require_inside_of
from tests.support import reference
from tests.support.devices import DEVICES

BOX = gk.mesh.box((2.0, 2.0, 2.0))
BALL = gk.mesh.sphere(1.4, segments=32)
TORUS = mesh_catalog.torus(major=2.0, minor=1.2)


def deck(height, half=0.9, segments=1, x=0.0):
    """A horizontal square sheet, which faces up."""
    return gk.mesh.plane((2.0 * half, 2.0 * half), segments=segments, center=(x, 0.0, height))


def turned(mesh):
    return TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])


HEIGHTS = np.linspace(-0.7, 0.7, 8)
DECKS = {
    "one": (BOX, [deck(0.1)]),
    "three up": (BOX, [deck(z) for z in (-0.5, 0.0, 0.5)]),
    "eight in turn": (BOX, [deck(z) if k % 2 else turned(deck(z)) for k, z in enumerate(HEIGHTS)]),
    "to the walls": (BOX, [deck(z, half=1.0) for z in HEIGHTS]),
    "of many faces": (BALL, [deck(z, half=0.8, segments=9) for z in HEIGHTS]),
    "in a ring": (TORUS, [deck(z, half=0.4, x=2.0) for z in HEIGHTS]),
    "both sides": (BOX, [one for z in HEIGHTS for one in (deck(z), turned(deck(z)))]),
    "copies": (BOX, [deck(0.2), deck(0.2), deck(0.2)]),
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", DECKS)
def test_decks_change_no_side(name, device):
    hull, decks = DECKS[name]
    mesh = mesh_catalog.join(hull, *decks)
    surface = require_inside_of(mesh, hull, device=device)
    count = sum(one.face_count for one in decks)
    assert surface.sign_reason.startswith(f"{count} faces of open sheets inside of bodies are left out; closed")
    assert not surface.is_closed
    points = np.random.default_rng(3).uniform(-1.3, 1.3, (500, 3))
    exact = reference.winding_number(hull.vertices, hull.faces, points)
    np.testing.assert_allclose(surface.winding_number(points), exact, atol=0.02)
    whole = reference.winding_number(mesh.vertices, mesh.faces, points)
    np.testing.assert_allclose(surface.winding_number(points, as_given=True), whole, atol=0.02 * (1 + len(decks)))


def test_the_order_of_faces_windings_and_single_corners_change_nothing():
    hull, decks = DECKS["three up"]
    for body in (hull, turned(hull)):
        mesh = mesh_catalog.join(*decks, body)
        require_inside_of(mesh_catalog.soup(mesh), hull)
        shuffled = TriangleMesh(mesh.vertices, np.random.default_rng(5).permutation(mesh.faces))
        require_inside_of(shuffled, hull)


@pytest.mark.parametrize("single", [np.float64, np.float32])
def test_one_wall_between_two_rooms(single):
    """Also where its edges are those of the shell, which have three faces then."""
    low, high = mesh_catalog.box(), mesh_catalog.box((0, 0, 1), (1, 1, 2))
    both = mesh_catalog.join(low, high)
    wall = gk.mesh.drop_degenerate(gk.mesh.merge_vertices(both), duplicates=True)
    assert gk.mesh.audit(wall).non_manifold_edge_count == 4
    wall = TriangleMesh(wall.vertices.astype(single), wall.faces)
    surface = Surface(wall, device="cpu")
    points = np.random.default_rng(6).uniform(-0.5, 2.5, (3000, 3))
    inside = ((points > [0, 0, 0]) & (points < [1, 1, 2])).all(axis=1)
    assert np.array_equal(surface.contains(points), inside)


def test_sheets_outside_and_across_count_as_before():
    ribs = [mesh_catalog.moved(deck(0.0, half=0.3), (3.0, 0.0, 0.0)), deck(0.2, half=1.6)]
    for rib in ribs:
        surface = Surface(mesh_catalog.join(BOX, rib), device="cpu")
        assert surface.sign_reason == "boundary edges: 4"
        assert surface.sign_method == "winding"
        beside = np.array([[0.0, 0.0, 0.9], [0.0, 0.0, -0.9], [0.0, 0.0, 1.2], [0.0, 0.0, -1.2]])
        assert surface.contains(beside).tolist() == [True, True, False, False]


def test_a_sheet_in_a_cavity_is_not_inside_of_the_solid():
    hollow = mesh_catalog.join(BOX, turned(gk.mesh.box((1.6, 1.6, 1.6))))
    surface = Surface(mesh_catalog.join(hollow, deck(0.0, half=0.5)), device="cpu")
    assert surface.sign_reason == "boundary edges: 4"
    assert surface.contains([[0.0, 0.0, 0.9], [0.0, 0.0, 0.5]]).tolist() == [True, False]
    surface = Surface(mesh_catalog.join(hollow, deck(0.9, half=0.5)), device="cpu")
    assert "open sheets inside of bodies" in surface.sign_reason


def test_open_bodies_keep_their_sheets():
    """Nothing says what is inside of an open box but all of its faces."""
    surface = Surface(mesh_catalog.join(mesh_catalog.box_without_a_lid(), deck(0.5, half=0.2)), device="cpu")
    assert surface._signs is surface


def test_fields_and_many_meshes_have_the_same_sides():
    hull, decks = DECKS["eight in turn"]
    mesh = mesh_catalog.join(hull, *decks)
    points = np.random.default_rng(7).uniform(-1.5, 1.5, (4000, 3))
    inside = (np.abs(points) < 1.0).all(axis=1)
    clear = np.abs(np.abs(points).max(axis=1) - 1.0) > 0.1
    kept = gk.volume.from_mesh(mesh, 0.1, half_width=4.0, interior="keep", device="cpu")
    assert np.array_equal(kept.sample(points[clear], device="cpu") < 0.0, inside[clear])
    many = gk.mesh.Surfaces([mesh, hull, mesh_catalog.icosphere()], device="cpu")
    offsets = np.array([0, len(points), len(points), len(points)])
    assert np.array_equal(many.contains(points, offsets), inside)
    assert np.array_equal(many.signed_distance(points, offsets).distance < 0.0, inside)


@pytest.mark.parametrize("sign", SIGNS)
def test_moved_vertices_are_looked_at_again(sign):
    hull, decks = DECKS["three up"]
    mesh = mesh_catalog.join(hull, *decks)
    surface = Surface(mesh, device="cpu")
    assert surface.contains([[0.0, 0.0, 0.25]], sign=sign)[0]
    moved = mesh.vertices.copy()
    moved[hull.vertex_count :, 2] += 5.0  # the decks leave the hull
    surface.update(moved)
    assert surface._signs is surface
    moved[hull.vertex_count :, 2] -= 5.0
    surface.update(moved)
    assert surface._signs is not surface
    assert surface.contains([[0.0, 0.0, 0.25]], sign=sign)[0]
