"""Closest points against brute force, and their invariances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.catalog import mesh_catalog
from geokit.core import launcher
from geokit.mesh import Surface, TriangleMesh
from tests.support import reference

MESHES = [
    mesh_catalog.tetrahedron(),
    mesh_catalog.box(),
    mesh_catalog.icosphere(2),
    mesh_catalog.torus(16, 8),
    mesh_catalog.open_shell(),
    mesh_catalog.sliver_fan(),
    mesh_catalog.duplicate_faces(),
    mesh_catalog.overlapping_spheres(),
    mesh_catalog.zero_area_triangles(),
    mesh_catalog.collapsed_faces(),
]


def queries_around(mesh: TriangleMesh, count: int, seed: int) -> np.ndarray:
    """Uniform in twice the box, near the surface, and exactly on vertices and edges."""
    rng = np.random.default_rng(seed)
    lower, upper = mesh.bounds
    size = (upper - lower).max()
    near = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=count)]].mean(axis=1)
    face = mesh.faces[rng.integers(len(mesh.faces), size=count // 4)]
    return np.concatenate(
        [
            (lower + upper) / 2 + rng.uniform(-1, 1, (count, 3)) * size,
            near + rng.normal(0, 0.01 * size, near.shape),
            mesh.vertices[face[:, 0]],
            (mesh.vertices[face[:, 0]] + mesh.vertices[face[:, 1]]) / 2,
        ]
    )


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("mesh", MESHES, ids=lambda mesh: mesh.name)
def test_distance_is_that_of_brute_force(mesh, offset):
    mesh = mesh_catalog.moved(mesh, (offset, -offset, offset / 2))
    queries = queries_around(mesh, 120, seed=7)
    found = Surface(mesh, device="cpu").closest_point(queries)
    expected = reference.closest_point(mesh.vertices, mesh.faces, queries)
    np.testing.assert_allclose(found.distance, expected.distance, rtol=0, atol=1e-12 * mesh.diagonal)
    # The point lies on the given triangle, at the given distance.
    corners = mesh.vertices[mesh.faces[found.triangle_id]]
    assert found.barycentric.min() >= -1e-12
    np.testing.assert_allclose(found.barycentric.sum(axis=1), 1.0, atol=1e-12)
    rebuilt = np.einsum("nk,nkd->nd", found.barycentric, corners)
    position = 1e-12 * mesh.diagonal + 4e-16 * offset
    np.testing.assert_allclose(found.points, rebuilt, rtol=0, atol=position)


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1e4, 1e9])
def test_scale_does_not_matter(scale):
    mesh = mesh_catalog.torus(16, 8)
    queries = queries_around(mesh, 100, seed=8)
    plain = Surface(mesh, device="cpu").closest_point(queries)
    scaled = Surface(mesh_catalog.scaled(mesh, scale), device="cpu").closest_point(queries * scale)
    np.testing.assert_allclose(scaled.distance / scale, plain.distance, rtol=0, atol=1e-13 * mesh.diagonal)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), faces=st.integers(1, 60), count=st.integers(1, 40))
def test_random_soups(seed, faces, count):
    rng = np.random.default_rng(seed)
    # A power of a uniform number makes some triangles tiny and some coordinates equal.
    vertices = rng.integers(-8, 9, (3 * faces, 3)) * 10.0 ** rng.integers(-3, 1, (3 * faces, 1))
    mesh = TriangleMesh(vertices, np.arange(3 * faces).reshape(-1, 3))
    queries = rng.uniform(-12, 12, (count, 3))
    found = Surface(mesh, device="cpu").closest_point(queries)
    expected = reference.closest_point(mesh.vertices, mesh.faces, queries)
    np.testing.assert_allclose(found.distance, expected.distance, rtol=0, atol=1e-12 * max(mesh.diagonal, 1e-3))


def test_order_threads_and_repetition_change_no_bit(monkeypatch):
    mesh = mesh_catalog.icosphere(4)
    surface = Surface(mesh, device="cpu")
    queries = queries_around(mesh, 4000, seed=9)
    first = surface.closest_point(queries)
    shuffle = np.random.default_rng(10).permutation(len(queries))
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("GEOKIT_THREADS", threads)
        again = surface.closest_point(queries[shuffle])
        for a, b in zip(first, again, strict=True):
            np.testing.assert_array_equal(a[shuffle], b)


def test_blocks_change_no_bit(monkeypatch):
    surface = Surface(mesh_catalog.torus(20, 10), device="cpu")
    queries = queries_around(surface.mesh, 3000, seed=13)
    rays = queries[::-1] - queries
    rays[np.abs(rays).max(axis=1) == 0] = 1.0
    whole = (*surface.signed_distance(queries), *surface.raycast(queries, rays))
    # Blocks of a size that does not divide the queries, above and below what is ordered.
    for block in (2500, 700):
        monkeypatch.setattr(launcher, "BLOCK", block)
        for a, b in zip(whole, (*surface.signed_distance(queries), *surface.raycast(queries, rays)), strict=True):
            np.testing.assert_array_equal(a, b)


def test_permuted_faces_give_the_same_distances():
    mesh = mesh_catalog.torus(20, 10)
    queries = queries_around(mesh, 300, seed=11)
    plain = Surface(mesh, device="cpu").closest_point(queries)
    order = np.random.default_rng(12).permutation(len(mesh.faces))
    mixed = Surface(TriangleMesh(mesh.vertices, mesh.faces[order]), device="cpu").closest_point(queries)
    np.testing.assert_allclose(mixed.distance, plain.distance, rtol=0, atol=1e-15 * mesh.diagonal)
