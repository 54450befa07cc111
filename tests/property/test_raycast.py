"""First hits against brute force over all triangles."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.mesh import Surface
from tests import catalogue, reference

MESHES = [
    catalogue.tetrahedron(),
    catalogue.icosphere(2),
    catalogue.torus(16, 8),
    catalogue.open_shell(),
    catalogue.overlapping_spheres(),
    catalogue.flipped_faces(),
]


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("mesh", MESHES, ids=lambda mesh: mesh.name)
def test_first_hit_is_that_of_brute_force(mesh, offset):
    mesh = catalogue.moved(mesh, (offset, offset, -offset))
    rng = np.random.default_rng(21)
    lower, upper = mesh.bounds
    origins = (lower + upper) / 2 + rng.uniform(-1, 1, (400, 3)) * (upper - lower).max()
    directions = rng.normal(size=(400, 3)) * 10.0 ** rng.uniform(-3, 3, (400, 1))
    surface = Surface(mesh, device="cpu")
    found = surface.raycast(origins, directions)
    expected = reference.first_hit(mesh.vertices, mesh.faces, origins, directions)
    hit = expected.triangle_id >= 0
    assert hit.any()
    assert not hit.all()
    np.testing.assert_array_equal(found.triangle_id >= 0, hit)
    length = np.linalg.norm(directions, axis=1)
    np.testing.assert_allclose(
        (found.t * length)[hit], (expected.t * length)[hit], rtol=0, atol=1e-11 * mesh.diagonal + 1e-15 * offset
    )
    np.testing.assert_array_equal(surface.occluded(origins, directions), hit)
    corners = mesh.vertices[mesh.faces[found.triangle_id[hit]]]
    on_triangle = np.einsum("nk,nkd->nd", found.barycentric[hit], corners)
    on_ray = origins[hit] + found.t[hit, None] * directions[hit]
    np.testing.assert_allclose(on_triangle, on_ray, rtol=0, atol=1e-11 * mesh.diagonal + 1e-15 * offset)


def test_order_and_threads_change_no_bit(monkeypatch):
    surface = Surface(catalogue.icosphere(3), device="cpu")
    rng = np.random.default_rng(22)
    origins, directions = rng.normal(size=(6000, 3)) * 2, rng.normal(size=(6000, 3))
    first = surface.raycast(origins, directions)
    shuffle = rng.permutation(6000)
    monkeypatch.setenv("GEOKIT_THREADS", "3")
    again = surface.raycast(origins[shuffle], directions[shuffle])
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a[shuffle], b)
