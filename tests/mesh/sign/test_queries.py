"""Each sign method against brute-force winding numbers in float64."""

from __future__ import annotations

import functools

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from tests.support import reference

CLEAN = [
    make
    for make in mesh_catalog.CLOSED
    if make.__name__ not in ("overlapping_spheres", "two_boxes_touching_at_a_vertex")
]


def points_of(mesh, count=3000, seed=0):
    """Points in the box around the mesh, and as many next to faces, edges and vertices."""
    rng = np.random.default_rng(seed)
    lower, upper = mesh.bounds
    spread = lower + (rng.random((count, 3)) * 1.4 - 0.2) * (upper - lower)
    face = mesh.faces[rng.integers(len(mesh.faces), size=count)]
    weights = rng.dirichlet([0.4] * 3, count)
    weights[: count // 3] = np.eye(3)[rng.integers(3, size=count // 3)]
    on = np.einsum("nk,nkd->nd", weights, mesh.vertices[face])
    near = on + rng.normal(size=(count, 3)) * mesh.diagonal * 10.0 ** rng.uniform(-5.5, -1, (count, 1))
    return np.concatenate([spread, near])


def is_inside(mesh, points):
    return reference.winding_number(mesh.vertices, mesh.faces, points) > 0.5


@functools.cache
def clean(make):
    """A surface, points, and which of them are inside."""
    mesh = make()
    points = points_of(mesh)
    return gk.mesh.Surface(mesh, device="cpu"), points, is_inside(mesh, points)


@pytest.mark.slow
@pytest.mark.parametrize("sign", ["pseudonormal", "winding", "parity", "auto"])
@pytest.mark.parametrize("make", CLEAN)
def test_signs_of_clean_meshes(make, sign):
    surface, points, inside = clean(make)
    found = surface.signed_distance(points, sign=sign)
    far = np.abs(found.distance) > 1e-6 * surface.mesh.diagonal
    np.testing.assert_array_equal(found.distance[far] < 0, inside[far])
    np.testing.assert_array_equal(np.abs(found.distance), surface.closest_point(points).distance)
    np.testing.assert_array_equal(surface.contains(points, sign=sign), found.distance < 0)


@pytest.mark.parametrize("sign", ["pseudonormal", "parity"])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_exact_methods_are_right_up_to_rounding(sign, scale):
    # The winding number in float32 promises 1e-6 diagonals; these two methods are limited only by float64.
    mesh = mesh_catalog.scaled(mesh_catalog.torus(), scale)
    surface = gk.mesh.Surface(mesh, device="cpu")
    rng = np.random.default_rng(1)
    face = mesh.faces[rng.integers(len(mesh.faces), size=2000)]
    corners = mesh.vertices[face]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    on = np.einsum("nk,nkd->nd", rng.dirichlet([2.0] * 3, 2000), corners)
    height = rng.choice([-1.0, 1.0], 2000) * 1e-12 * mesh.diagonal
    distance = surface.signed_distance(on + height[:, None] * normal, sign=sign).distance
    np.testing.assert_array_equal(np.sign(distance), np.sign(height))


def test_soup_has_the_signs_of_the_mesh():
    mesh = mesh_catalog.l_profile()
    points = points_of(mesh)
    whole, parts = (gk.mesh.Surface(m, device="cpu") for m in (mesh, mesh_catalog.soup(mesh)))
    for sign in ("pseudonormal", "winding", "parity"):
        np.testing.assert_array_equal(
            whole.signed_distance(points, sign=sign).distance, parts.signed_distance(points, sign=sign).distance
        )


@pytest.mark.parametrize("sign", ["pseudonormal", "winding", "parity"])
def test_inside_out_meshes_have_an_inside(sign):
    surface = gk.mesh.Surface(mesh_catalog.inside_out_box(), device="cpu")
    np.testing.assert_array_equal(surface.contains([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5]], sign=sign), [True, False])


def test_misses_keep_a_sign():
    surface = gk.mesh.Surface(mesh_catalog.box((0, 0, 0), (10, 10, 10)), device="cpu")
    for sign in ("pseudonormal", "winding", "parity"):
        found = surface.signed_distance([[5.0, 5, 5], [-5.0, 5, 5], [0.5, 5, 5]], sign=sign, max_distance=1.0)
        np.testing.assert_array_equal(found.distance, [-np.inf, np.inf, -0.5])
        np.testing.assert_array_equal(found.triangle_id[:2], [-1, -1])


def test_confidence_is_low_in_a_hole_and_high_elsewhere():
    mesh = mesh_catalog.holed_sphere(1)
    surface = gk.mesh.Surface(mesh, device="cpu")
    hole = mesh.vertices[mesh_catalog.icosphere().faces[0]].mean(axis=0)
    inside, in_hole, outside = surface.sign_confidence([[0.0, 0, 0], hole, -3.0 * hole])
    assert inside > 0.45
    assert outside > 0.45
    assert in_hole < 0.2
    winding = surface.winding_number([[0.0, 0, 0], hole, -3.0 * hole])
    np.testing.assert_allclose([inside, in_hole, outside], np.abs(winding - 0.5))


def test_unknown_sign_is_refused():
    surface = gk.mesh.Surface(mesh_catalog.box(), device="cpu")
    with pytest.raises(gk.InputError, match="sign: 'normal' is not known; use one of 'auto'"):
        surface.signed_distance([[0.0, 0, 0]], sign="normal")
    with pytest.raises(gk.InputError, match="sign"):
        surface.contains([[0.0, 0, 0]], sign="")


@pytest.mark.parametrize("make", [*mesh_catalog.CLOSED, *mesh_catalog.OPEN, *mesh_catalog.DEFECTIVE])
@pytest.mark.parametrize("offset", [0.0, 1e7])
def test_furthest_point_is_that_of_brute_force(make, offset):
    mesh = mesh_catalog.moved(make(), (offset, -offset, offset))
    surface = gk.mesh.Surface(mesh, device="cpu")
    far = mesh.bounds.mean(axis=0) + np.array([1e5 * mesh.diagonal, 0.0, 0.0])
    points = np.concatenate([points_of(mesh, 150), far[None]])
    found = surface.furthest_point(points)
    used = mesh.vertices[np.unique(mesh.faces)]
    expected = np.linalg.norm(points[:, None] - used[None], axis=2).max(axis=1)
    np.testing.assert_allclose(found.distance, expected, rtol=1e-15)
    corners = mesh.vertices[mesh.faces[found.triangle_id]]
    assert np.all((corners == found.points[:, None]).all(axis=2).any(axis=1))


def test_furthest_ties_go_to_the_lowest_triangle():
    surface = gk.mesh.Surface(mesh_catalog.box(), device="cpu")
    found = surface.furthest_point([[0.5, 0.5, 0.5]])
    assert found.triangle_id[0] == 0
    assert found.distance[0] == pytest.approx(np.sqrt(0.75))
    np.testing.assert_array_equal(found.points[0], surface.mesh.vertices[surface.mesh.faces[0, 0]])
