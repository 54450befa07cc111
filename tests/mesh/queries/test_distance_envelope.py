"""Limits of offset, size and thinness: distances and hits stay exact to 1e-6 of the mesh's size.

The rounding of float64 coordinates is not an error of the query: the reference uses the same rounded vertices.
"""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from tests.support import reference

MESHES = [mesh_catalog.box, lambda: mesh_catalog.torus(20, 10), mesh_catalog.l_profile]
# Rounding of the coordinates themselves, a few times over.
COORDINATE = 8 * np.finfo(np.float64).eps


def queries(mesh, count=40):
    rng = np.random.default_rng(5)
    lower, upper = mesh.bounds
    around = lower + (rng.random((count, 3)) * 2 - 0.5) * (upper - lower)
    face = mesh.faces[rng.integers(len(mesh.faces), size=count)]
    near = mesh.vertices[face].mean(axis=1) + rng.normal(size=(count, 3)) * 1e-3 * mesh.diagonal
    return np.concatenate([around, near])


def check(mesh, extent):
    """``extent`` is how far the mesh lies from the origin."""
    surface = gk.mesh.Surface(mesh, device="cpu")
    points = queries(mesh)
    tolerance = 1e-11 * mesh.diagonal + COORDINATE * extent
    assert tolerance <= 1e-6 * mesh.diagonal
    expected = reference.closest_point(mesh.vertices, mesh.faces, points)
    found = surface.closest_point(points)
    np.testing.assert_allclose(found.distance, expected.distance, rtol=0, atol=tolerance)
    directions = points[::-1] - points
    directions[np.abs(directions).max(axis=1) == 0] = mesh.diagonal
    hits = surface.raycast(points, directions)
    first = reference.first_hit(mesh.vertices, mesh.faces, points, directions)
    np.testing.assert_array_equal(hits.triangle_id >= 0, first.triangle_id >= 0)
    hit = hits.triangle_id >= 0
    length = np.linalg.norm(directions, axis=1)
    np.testing.assert_allclose((hits.t * length)[hit], (first.t * length)[hit], rtol=0, atol=100 * tolerance)


@pytest.mark.parametrize("make", MESHES, ids=["box", "torus", "l_profile"])
@pytest.mark.parametrize("offset", [10.0**k for k in range(9)])
def test_far_from_the_origin(make, offset):
    check(mesh_catalog.far_away(make(), offset), offset)


@pytest.mark.parametrize("make", MESHES, ids=["box", "torus", "l_profile"])
@pytest.mark.parametrize("scale", [10.0**k for k in range(-9, 10, 3)])
def test_small_and_large(make, scale):
    mesh = mesh_catalog.scaled(make(), scale)
    check(mesh, mesh.diagonal)


@pytest.mark.parametrize("aspect", [1e2, 1e4, 1e6, 1e8])
def test_slivers(aspect):
    mesh = mesh_catalog.sliver_fan(24, 24 / aspect)
    rng = np.random.default_rng(6)
    # Around the slivers at all distances, from zero to their length.
    on = rng.random((400, 3)) * [1.0, 24 / aspect, 0.0]
    points = on + rng.normal(size=(400, 3)) * 10.0 ** rng.uniform(-10, 0, (400, 1))
    found = gk.mesh.Surface(mesh, device="cpu").closest_point(points)
    expected = reference.closest_point(mesh.vertices, mesh.faces, points)
    np.testing.assert_allclose(found.distance, expected.distance, rtol=0, atol=1e-11)


def test_queries_far_from_the_mesh():
    mesh = mesh_catalog.torus(20, 10)
    rng = np.random.default_rng(7)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = directions * 10.0 ** rng.uniform(0, 12, (300, 1))
    found = gk.mesh.Surface(mesh, device="cpu").closest_point(points)
    expected = reference.closest_point(mesh.vertices, mesh.faces, points)
    np.testing.assert_allclose(found.distance, expected.distance, rtol=4e-15)
