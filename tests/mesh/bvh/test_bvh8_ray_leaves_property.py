"""Ray leaves on a CPU have 16 bits per coordinate: they select candidates and never change an answer."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit.mesh import Surface, TriangleMesh
from geokit.mesh.bvh.bvh8_build_cpu_kernels import HEAD, LEAF_WORDS, LEAST_QUANTUM
from tests.support.effort import spread

RAYS = 20_000


def soup(corners: np.ndarray, name: str) -> TriangleMesh:
    return TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), name=name)


def mixed_sizes(rng: np.random.Generator) -> TriangleMesh:
    """Triangles from the size of the mesh down to a billionth of it, in the same leaves."""
    sizes = 10.0 ** rng.uniform(-9, 0, (3000, 1, 1))
    return soup(rng.normal(size=(3000, 1, 3)) + sizes * rng.normal(size=(3000, 3, 3)), "mixed sizes")


def cluster(rng: np.random.Generator) -> TriangleMesh:
    """Leaves of size 1e-5 down to less than a quantum, away from the middle of a large triangle's box."""
    size = 10.0 ** rng.uniform(-8, -5, (500, 1, 1))
    small = 0.3 + size * (3.0 * rng.normal(size=(500, 1, 3)) + rng.normal(size=(500, 3, 3)))
    large = np.array([[[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0], [1.0, -1.0, 0.0]]])
    return soup(np.concatenate([large, small]), "cluster")


def needles(rng: np.random.Generator) -> TriangleMesh:
    """Slivers of aspect ratios up to 1e12."""
    along = rng.normal(size=(2000, 1, 3)) * np.array([0.0, 0.5, 1.0])[None, :, None]
    aside = rng.normal(size=(2000, 3, 3)) * 10.0 ** rng.uniform(-12, -2, (2000, 1, 1))
    return soup(rng.normal(size=(2000, 1, 3)) + along + aside, "needles")


MAKERS = {"mixed sizes": mixed_sizes, "cluster": cluster, "needles": needles}
INSIDE = {"sphere": (0.0, 0.0, 0.0), "torus": (1.0, 0.0, 0.0), "l_profile": (0.4, 0.4, 0.4)}
SOLIDS = {
    "sphere": mesh_catalog.icosphere(4),
    "torus": mesh_catalog.torus(64, 32),
    "l_profile": mesh_catalog.l_profile(),
}


def mesh_of(name: str) -> TriangleMesh:
    return SOLIDS[name] if name in SOLIDS else MAKERS[name](np.random.default_rng(61))


def aims(mesh: TriangleMesh, rng: np.random.Generator, least: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Triangles, and points in them whose weights are ``least`` or more."""
    triangle = rng.integers(len(mesh.faces), size=RAYS)
    weights = least + (1.0 - 3.0 * least) * rng.dirichlet(np.full(3, 0.3), size=RAYS)
    return triangle, np.einsum("nc,ncd->nd", weights, mesh.vertices[mesh.faces[triangle]])


@pytest.mark.parametrize("offset", [0.0, 1e5])
@pytest.mark.parametrize("name", [*SOLIDS, *MAKERS])
def test_corners_are_within_half_a_quantum(name, offset):
    mesh = mesh_catalog.moved(mesh_of(name), (offset, -offset, offset))
    surface = Surface(mesh, device="cpu")
    tree = surface._ray_tree
    words = tree.ray_leaves.numpy().reshape(-1, LEAF_WORDS)
    triangles = tree.slot_triangle.numpy().reshape(-1, 8)
    there = triangles >= 0
    bits = words[:, HEAD + 6].copy().view(np.uint32)
    np.testing.assert_array_equal(bits[:, None] >> np.arange(8) & 1, there)
    corners = words[:, :HEAD].copy().view(np.uint16).reshape(-1, 3, 3, 8).transpose(0, 3, 1, 2)
    quantum = 1.0 / words[:, HEAD + 3].astype(np.float64)
    assert (quantum >= LEAST_QUANTUM).all()
    local = (mesh.vertices[mesh.faces[triangles]] - surface.origin) / surface.scale
    shown = words[:, None, None, HEAD : HEAD + 3] + corners * quantum[:, None, None, None]
    off = np.abs(shown - local).max(axis=(2, 3))[there]
    assert (off <= 0.5001 * np.broadcast_to(quantum[:, None], there.shape)[there] + 1e-15).all()


@pytest.mark.slow
@pytest.mark.parametrize("distance", spread([1e-3, 1.0, 1e5], 2))
@pytest.mark.parametrize("name", [*SOLIDS, *MAKERS])
def test_what_a_ray_is_aimed_at_is_not_passed_by(name, distance):
    mesh = mesh_of(name)
    surface = Surface(mesh, device="cpu")
    rng = np.random.default_rng(62)
    # Well inside the triangles, by more than the rounding of the rays' own numbers.
    size = np.ptp(mesh.vertices[mesh.faces], axis=1).max(axis=1)
    triangle, points = aims(mesh, rng, least=0.01)
    origins = points + distance * mesh.diagonal * rng.normal(size=(RAYS, 3))
    offsets, _, found, _ = surface.raycast_all(origins, points - origins)
    ray = np.repeat(np.arange(RAYS), np.diff(offsets))
    listed = np.zeros(RAYS, bool)
    listed[ray[found == triangle[ray]]] = True
    corners = mesh.vertices[mesh.faces[triangle]]
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(ab, ac)
    height = np.linalg.norm(normal, axis=1) / size[triangle]
    way = points - origins
    sine = np.abs(np.einsum("nd,nd->n", normal, way)) / (np.linalg.norm(normal, axis=1) * np.linalg.norm(way, axis=1))
    clear = height * sine * 0.01 > 1e-14 * (1.0 + distance) * mesh.diagonal
    assert clear.any()
    assert listed[clear].all()


@pytest.mark.parametrize("name", SOLIDS)
def test_rays_from_inside_hit_at_edges_and_vertices(name):
    mesh = mesh_of(name)
    rng = np.random.default_rng(63)
    a, b = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=RAYS)]].transpose(1, 0, 2)[:2]
    points = a + rng.choice([0.0, 0.5, 0.7], size=(RAYS, 1)) * (b - a)
    origins = np.array(INSIDE[name]) + 1e-3 * rng.normal(size=(RAYS, 3))
    assert np.isfinite(Surface(mesh, device="cpu").raycast(origins, points - origins).t).all()


@pytest.mark.parametrize("name", ["needles", "zero area"])
def test_limits_are_those_of_the_refined_t(name):
    # By its weights, a sliver's t is off by up to the sliver's length.
    mesh = mesh_catalog.zero_area_triangles() if name == "zero area" else mesh_of(name)
    surface = Surface(mesh, device="cpu")
    rng = np.random.default_rng(64)
    origins, targets = aims(mesh, rng)[1], aims(mesh, rng)[1]
    kept = np.abs(targets - origins).max(axis=1) > 0
    rays = origins[kept], (targets - origins)[kept]
    limits = {"t_min": 1e-3, "max_distance": 0.3 * mesh.diagonal}
    hit = surface.raycast(*rays, **limits).triangle_id >= 0
    assert hit.any()
    np.testing.assert_array_equal(surface.occluded(*rays, **limits), hit)


def test_leaves_follow_the_vertices():
    mesh = mesh_catalog.icosphere(3)
    surface = Surface(mesh, device="cpu")
    origins, directions = np.tile([0.0, 0.0, 5.0], (100, 1)), np.tile([0.0, 0.0, -1.0], (100, 1))
    origins[:, :2] += np.random.default_rng(66).uniform(-0.5, 0.5, (100, 2))
    before = surface.raycast(origins, directions)
    moved = mesh.vertices * [1.0, 1.0, 3.0] + [0.1, 0.0, 0.0]
    surface.update(moved)
    fresh = Surface(TriangleMesh(moved, mesh.faces), device="cpu").raycast(origins, directions)
    after = surface.raycast(origins, directions)
    assert (after.t != before.t).any()
    for a, b in zip(after, fresh, strict=True):
        assert a.tobytes() == b.tobytes()
