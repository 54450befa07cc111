"""Rays aimed exactly at edges and vertices of closed meshes, from inside: none may escape."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit.mesh import Surface, TriangleMesh
from tests.support import reference


def subdivided_box(times: int) -> TriangleMesh:
    """A box of many coplanar triangles: the hardest case, as the boxes of the tree have no depth there."""
    count = 2**times
    steps = np.arange(count + 1) / count
    u, v = (a.ravel() for a in np.meshgrid(steps, steps, indexing="ij"))
    corner = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    quads = np.stack([corner, corner + count + 1, corner + count + 2, corner + 1], axis=1)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices, triangles = [], []
    for axis in range(3):
        for side in (0.0, 1.0):
            plane = np.empty((len(u), 3))
            plane[:, axis], plane[:, (axis + 1) % 3], plane[:, (axis + 2) % 3] = side, u, v
            triangles.append((faces if side else faces[:, ::-1]) + sum(map(len, vertices)))
            vertices.append(plane)
    points, inverse = np.unique(np.concatenate(vertices), axis=0, return_inverse=True)
    return TriangleMesh(points * 2 - 1, inverse[np.concatenate(triangles)])


CLOSED = {
    "box": subdivided_box(4),
    "sphere": mesh_catalog.icosphere(4),
    "torus": mesh_catalog.torus(64, 32),
    "l_profile": mesh_catalog.l_profile(),
}
CONVEX = ("box", "sphere")
RAYS = 100_000


def starts_inside(surface: Surface, count: int, rng: np.random.Generator) -> np.ndarray:
    lower, upper = surface.mesh.bounds
    drawn = rng.uniform(lower, upper, (40 * 64, 3))
    margin = 0.02 * surface.mesh.diagonal
    inside = drawn[surface.signed_distance(drawn).distance < -margin]
    assert len(inside) > 10
    return inside[rng.integers(len(inside), size=count)]


@pytest.mark.slow
@pytest.mark.parametrize("exact", ["float32", "float64"])
@pytest.mark.parametrize("name", CLOSED)
def test_no_ray_from_inside_gets_out(name, exact):
    mesh = CLOSED[name]
    if exact == "float32":
        mesh = TriangleMesh(mesh.vertices.astype(np.float32), mesh.faces)
    surface = Surface(mesh, device="cpu")
    rng = np.random.default_rng(31)
    starts = starts_inside(surface, RAYS, rng).astype(exact).astype(np.float64)
    at_vertices = mesh.vertices[mesh.faces.ravel()[rng.integers(mesh.faces.size, size=RAYS)]]
    face = mesh.faces[rng.integers(len(mesh.faces), size=RAYS)]
    share = rng.integers(0, 257, (RAYS, 1)) / 256
    at_edges = mesh.vertices[face[:, 0]] * share + mesh.vertices[face[:, 1]] * (1 - share)
    for targets in (at_vertices, at_edges):
        found = surface.raycast(starts, targets - starts)
        assert (found.triangle_id < 0).sum() == 0
        some = rng.integers(RAYS, size=60)
        expected = reference.first_hit(mesh.vertices, mesh.faces, starts[some], (targets - starts)[some])
        # Brute force may leak itself, or pass a silhouette on the other side; where it does not, the hits agree.
        same = np.abs(found.t[some] - expected.t) <= 1e-9
        assert same.mean() > 0.9
        if name in CONVEX:
            assert found.t.max() <= 1.0 + 1e-9
        assert surface.occluded(starts, targets - starts).all()


def test_far_starts_and_tiny_directions_do_not_leak():
    surface = Surface(mesh_catalog.icosphere(3), device="cpu")
    rng = np.random.default_rng(32)
    outward = rng.normal(size=(2000, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    for distance in (1e3, 1e6):
        starts = outward * distance
        targets = surface.mesh.vertices[rng.integers(len(surface.mesh.vertices), size=2000)] * 0.5
        hits = surface.raycast(starts, targets - starts)
        assert (hits.triangle_id < 0).sum() == 0
    small = surface.raycast(np.zeros((2000, 3)), outward * 1e-140)
    np.testing.assert_allclose(small.t * 1e-140, 1.0, atol=0.02)
