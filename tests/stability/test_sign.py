"""Signs and winding numbers towards where they fail: near the surface, far away, at holes, flips and overlaps."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.mesh import Surface
from tests import catalogue, reference

CLEAN = [
    catalogue.tetrahedron(),
    catalogue.box(),
    catalogue.icosphere(3),
    catalogue.torus(24, 12),
    catalogue.l_profile(),
]


def around(mesh, count, seed, distance):
    rng = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=count)]]
    weights = rng.dirichlet(np.ones(3), count)
    on_surface = np.einsum("nk,nkd->nd", weights, corners)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    side = rng.choice([-1.0, 1.0], (count, 1))
    return on_surface + side * normal * distance


@pytest.mark.parametrize("share", [1e-6, 1e-5, 1e-3, 1e-1])
@pytest.mark.parametrize("mesh", CLEAN, ids=lambda mesh: mesh.name)
def test_sign_on_clean_meshes_is_exact_beyond_a_millionth(mesh, share):
    points = around(mesh, 500, 41, share * mesh.diagonal)
    expected = reference.signed_distance(mesh.vertices, mesh.faces, points)
    # What was pushed out of one wall may have come close to another.
    sure = np.abs(expected) > 0.99e-6 * mesh.diagonal
    found = Surface(mesh, device="cpu").signed_distance(points).distance
    assert sure.sum() > 300
    np.testing.assert_array_equal(found[sure] < 0, expected[sure] < 0)
    np.testing.assert_allclose(np.abs(found), np.abs(expected), rtol=0, atol=1e-12 * mesh.diagonal)


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e6, 1e8])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_sign_does_not_depend_on_place_or_size(offset, scale):
    mesh = catalogue.scaled(catalogue.moved(catalogue.icosphere(2), (offset, -offset, offset)), scale)
    rng = np.random.default_rng(42)
    centre = np.array([offset, -offset, offset])
    points = rng.normal(size=(800, 3))
    radius = np.linalg.norm(points, axis=1)
    sure = (radius < 0.9) | (radius > 1.001)
    found = Surface(mesh, device="cpu").signed_distance((centre + points) * scale).distance
    np.testing.assert_array_equal(found[sure] < 0, radius[sure] < 1)


@pytest.mark.parametrize(
    "mesh",
    [catalogue.holed_sphere(), catalogue.overlapping_spheres(), catalogue.duplicate_faces(), catalogue.open_shell()],
    ids=lambda mesh: mesh.name,
)
def test_winding_number_is_within_two_hundredths(mesh):
    rng = np.random.default_rng(43)
    lower, upper = mesh.bounds
    points = (lower + upper) / 2 + rng.uniform(-1, 1, (1500, 3)) * (upper - lower).max()
    expected = reference.winding_number(mesh.vertices, mesh.faces, points)
    found = Surface(mesh, device="cpu").winding_number(points)
    assert np.abs(found - expected).max() <= 0.02


def test_signs_on_broken_meshes_follow_the_exact_winding_number():
    for mesh in (catalogue.holed_sphere(), catalogue.flipped_faces(), catalogue.overlapping_spheres()):
        rng = np.random.default_rng(44)
        lower, upper = mesh.bounds
        points = (lower + upper) / 2 + rng.uniform(-0.75, 0.75, (3000, 3)) * (upper - lower)
        exact = reference.winding_number(mesh.vertices, mesh.faces, points)
        sure = np.abs(exact - 0.5) > 0.02
        found = Surface(mesh, device="cpu").contains(points)
        np.testing.assert_array_equal(found[sure], exact[sure] > 0.5)


def test_far_away_points_are_outside():
    directions = np.random.default_rng(45).normal(size=(300, 3))
    for mesh in (catalogue.icosphere(2), catalogue.open_shell(), catalogue.holed_sphere()):
        surface = Surface(mesh, device="cpu")
        for distance in (1e2, 1e6, 1e12, 1e30):
            assert not surface.contains(directions * distance).any()
            assert np.abs(surface.winding_number(directions * distance)).max() < 0.01
