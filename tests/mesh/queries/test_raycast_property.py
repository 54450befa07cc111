"""First hits against brute force over all triangles."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit.mesh import Surface, TriangleMesh
from tests.support import reference

MESHES = [
    mesh_catalog.tetrahedron(),
    mesh_catalog.icosphere(2),
    mesh_catalog.torus(16, 8),
    mesh_catalog.open_shell(),
    mesh_catalog.overlapping_spheres(),
    mesh_catalog.flipped_faces(),
]


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("mesh", MESHES, ids=lambda mesh: mesh.name)
def test_first_hit_is_that_of_brute_force(mesh, offset):
    mesh = mesh_catalog.moved(mesh, (offset, offset, -offset))
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


def exact_t(triangle, origin, direction):
    """Ray parameter of a triangle's plane in rational arithmetic, and the sine of the angle between them."""
    a, b, c, start, way = ([Fraction(float(x)) for x in point] for point in (*triangle, origin, direction))
    e, f, rise = ([q - p for p, q in zip(a, end, strict=True)] for end in (b, c, start))
    normal = [e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0]]
    slope, size = sum(n * w for n, w in zip(normal, way, strict=True)), sum(n * n for n in normal)
    t = -sum(n * r for n, r in zip(normal, rise, strict=True)) / slope if slope else Fraction(0)
    return t, abs(float(slope)) / np.sqrt(float(size) * float(sum(w * w for w in way))) if size else 0.0


@pytest.mark.slow
@pytest.mark.parametrize("height", [1e-2, 1e-4, 1e-6, 1e-9, 1e-12, 1e-15])
@pytest.mark.parametrize("foot", [0.0, 0.3, 1.0])
def test_slivers_are_hit_where_their_planes_are(foot, height):
    # With the foot of their height at an end of the longest edge they are needles, else two of their corners are flat.
    rng = np.random.default_rng([23, int(1e3 * foot)])
    hits = 0
    for _ in range(12):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        flat = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [foot, height, 0.0]])
        triangle = flat[rng.permutation(3)] @ turn + rng.normal(size=3)
        origins = rng.normal(size=(12, 3))
        directions = rng.dirichlet([1, 1, 1], 12) @ triangle - origins
        surface = Surface(TriangleMesh(triangle, [[0, 1, 2]]), device="cpu")
        found, every = surface.raycast(origins, directions), surface.raycast_all(origins, directions)
        weights = found.barycentric
        # The hits are decided separately and exactly: rounding may make the two differ at the triangle's border.
        crossed = np.repeat(np.arange(12), np.diff(every.offsets))
        both = found.triangle_id[crossed] == 0
        np.testing.assert_array_equal(every.t[both], found.t[crossed[both]])
        for row in np.flatnonzero(found.triangle_id == 0):
            t, sine = exact_t(triangle, origins[row], directions[row])
            if sine < 0.05:
                continue
            hits += 1
            assert abs(float(Fraction(float(found.t[row])) - t)) < 1e-13
            assert weights[row].min() >= -1e-15
            # For a triangle thinner than rounding only a loose bound holds.
            off = weights[row] @ triangle - (origins[row] + found.t[row] * directions[row])
            assert np.abs(off).max() < (1e-13 if height > 1e-13 else 1e-2)
    assert hits > 80


@pytest.mark.parametrize("foot", [0.2, 0.4, 0.7])
def test_triangles_without_area_are_hit_on_their_line(foot):
    # Corners in small whole numbers: they lie on a line exactly.
    rng = np.random.default_rng(24)
    line = np.array([3.0, -2.0, 5.0])
    triangle = np.array([0.0 * line, 10.0 * line, 10.0 * foot * line])
    origins = rng.integers(-40, 40, (4000, 3)).astype(float)
    share = rng.uniform(0.05, 0.95, 4000)
    directions = share[:, None] * 10.0 * line - origins
    found = Surface(TriangleMesh(triangle, [[0, 1, 2]]), device="cpu").raycast(origins, directions)
    sine = np.linalg.norm(np.cross(directions, line), axis=1)
    sine /= np.linalg.norm(directions, axis=1) * np.linalg.norm(line)
    # Rounding lets few of them through.
    hit = (found.triangle_id == 0) & (sine > 0.05)
    assert hit.any()
    assert np.abs(found.t[hit] - 1.0).max() < 1e-13


def test_order_and_threads_change_no_bit(monkeypatch):
    surface = Surface(mesh_catalog.icosphere(3), device="cpu")
    rng = np.random.default_rng(22)
    origins, directions = rng.normal(size=(6000, 3)) * 2, rng.normal(size=(6000, 3))
    first = surface.raycast(origins, directions)
    shuffle = rng.permutation(6000)
    monkeypatch.setenv("GEOKIT_THREADS", "3")
    again = surface.raycast(origins[shuffle], directions[shuffle])
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a[shuffle], b)
