"""Signs and winding numbers near their limits: close to the surface, far away, at holes, flips and overlaps."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit.mesh import Surface
from tests.support import reference

CLEAN = [
    mesh_catalog.tetrahedron(),
    mesh_catalog.box(),
    mesh_catalog.icosphere(2),
    mesh_catalog.torus(24, 12),
    mesh_catalog.l_profile(),
    mesh_catalog.cone(200, 1.0),
    mesh_catalog.cone(200, 1e4),
]

# Defects as they occur in real files, applied to two good meshes.
BROKEN = [
    pytest.param(break_it(mesh), id=f"{mesh.name}: {name}")
    for mesh in (mesh_catalog.icosphere(3), mesh_catalog.torus(24, 12))
    for name, break_it in mesh_catalog.BROKEN.items()
]

# For simple surfaces; a mesh of k copies of itself has k times this error.
WINDING_ERROR = 0.005


def around(mesh, count, seed, distance):
    """Points at this distance from random points of the mesh, along the normal there."""
    rng = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=count)]]
    weights = rng.dirichlet(np.ones(3), count)
    # A fifth of them on an edge, and as many on a vertex.
    weights[: count // 5, 0] = 0
    weights[: count // 5] /= weights[: count // 5].sum(axis=1, keepdims=True)
    weights[count // 5 : 2 * count // 5] = [0, 1, 0]
    on_surface = np.einsum("nk,nkd->nd", weights, corners)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    side = rng.choice([-1.0, 1.0], (count, 1))
    return on_surface + side * normal * distance


def uniform_and_near(mesh, count, seed):
    """Half of the points in 1.5 times the box, half about the surface, sigma 1% of the diagonal."""
    rng = np.random.default_rng(seed)
    lower, upper = mesh.bounds
    uniform = (lower + upper) / 2 + rng.uniform(-0.75, 0.75, (count // 2, 3)) * (upper - lower)
    center = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=count - count // 2)]].mean(axis=1)
    return np.concatenate([uniform, center + rng.normal(0, 0.01 * mesh.diagonal, center.shape)])


def exact_winding(surface, points):
    """The float64 sum over the triangles that the surface counts, with the winding that it uses."""
    surface = surface._signs
    flipped = surface._orientation.flipped
    faces = np.where(flipped[:, None], surface.mesh.faces[:, ::-1], surface.mesh.faces)
    return reference.winding_number(surface.mesh.vertices, faces, points)


@pytest.mark.slow
@pytest.mark.parametrize("share", [1e-9, 1e-6, 1e-5, 1e-3, 1e-1])
@pytest.mark.parametrize("mesh", CLEAN, ids=lambda mesh: mesh.name)
def test_sign_on_clean_meshes_is_exact(mesh, share):
    points = around(mesh, 250, 41, share * mesh.diagonal)
    expected = reference.signed_distance(mesh.vertices, mesh.faces, points)
    # A point pushed out of one wall may have come close to another.
    sure = np.abs(expected) > 0.5 * min(share, 1e-6) * mesh.diagonal
    assert sure.sum() > 100
    surface = Surface(mesh, device="cpu")
    for sign in ("winding", "auto"):
        found = surface.signed_distance(points, sign=sign).distance
        np.testing.assert_array_equal(found[sure] < 0, expected[sure] < 0)
        np.testing.assert_allclose(np.abs(found), np.abs(expected), rtol=0, atol=1e-12 * mesh.diagonal)


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e6, 1e8])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_sign_does_not_depend_on_place_or_size(offset, scale):
    mesh = mesh_catalog.scaled(mesh_catalog.moved(mesh_catalog.icosphere(2), (offset, -offset, offset)), scale)
    rng = np.random.default_rng(42)
    center = np.array([offset, -offset, offset])
    points = rng.normal(size=(800, 3))
    radius = np.linalg.norm(points, axis=1)
    sure = (radius < 0.9) | (radius > 1.001)
    found = Surface(mesh, device="cpu").signed_distance((center + points) * scale, sign="winding").distance
    np.testing.assert_array_equal(found[sure] < 0, radius[sure] < 1)


@pytest.mark.slow
@pytest.mark.parametrize("mesh", BROKEN)
def test_signs_and_winding_numbers_of_broken_meshes(mesh):
    points = uniform_and_near(mesh, 1000, 44)
    surface = Surface(mesh, device="cpu")
    exact = exact_winding(surface, points)
    assert np.abs(surface.winding_number(points) - exact).max() <= WINDING_ERROR
    sure = np.abs(exact - 0.5) > 0.01
    assert sure.mean() > 0.9
    np.testing.assert_array_equal(surface.contains(points, sign="winding")[sure], exact[sure] > 0.5)
    np.testing.assert_array_equal(surface.signed_distance(points, sign="winding").distance[sure] < 0, exact[sure] > 0.5)


@pytest.mark.parametrize(
    "mesh", [make() for make in mesh_catalog.OPEN + mesh_catalog.DEFECTIVE], ids=lambda mesh: mesh.name
)
def test_winding_numbers_of_small_meshes(mesh):
    points = uniform_and_near(mesh, 800, 45)
    rng = np.random.default_rng(46)
    weights = rng.dirichlet(np.full(3, 0.3), 400)
    on_surface = np.einsum("nk,nkd->nd", weights, mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=400)]])
    offset = rng.normal(size=(400, 3)) * mesh.diagonal * 10.0 ** rng.uniform(-6, -2, (400, 1))
    points = np.concatenate([points, on_surface + offset])
    surface = Surface(mesh, device="cpu")
    # Closer to the surface, the two may differ in which points are inside.
    clear = surface.closest_point(points).distance > 1e-7 * mesh.diagonal
    assert clear.mean() > 0.9
    error = np.abs(surface.winding_number(points) - exact_winding(surface, points))
    assert error[clear].max() <= WINDING_ERROR


def test_far_away_points_are_outside():
    directions = np.random.default_rng(45).normal(size=(300, 3))
    for mesh in (mesh_catalog.icosphere(2), mesh_catalog.open_shell(), mesh_catalog.holed_sphere()):
        surface = Surface(mesh, device="cpu")
        for distance in (1e2, 1e6, 1e12, 1e30):
            assert not surface.contains(directions * distance, sign="winding").any()
            assert np.abs(surface.winding_number(directions * distance)).max() < 0.01
