"""On a CPU rays are set up in eights and traced together: this must not change any bit of an answer."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.catalog import mesh_catalog
from geokit.mesh import Surface, TriangleMesh
from geokit.mesh.queries.rays import RayHits
from tests.support.effort import of_all

SOLIDS = {
    "sphere": mesh_catalog.icosphere(4),
    "torus": mesh_catalog.torus(64, 32),
    "l_profile": mesh_catalog.l_profile(),
    "overlapping": mesh_catalog.overlapping_spheres(),
}
MESHES = SOLIDS | {
    "single": mesh_catalog.single_triangle(),
    "shell": mesh_catalog.open_shell(),
    "slivers": mesh_catalog.sliver_fan(),
    "zero_area": mesh_catalog.zero_area_triangles(),
}
SURFACES = {name: Surface(mesh, device="cpu") for name, mesh in MESHES.items()}


def require_same_one_by_one(surface: Surface, origins: np.ndarray, directions: np.ndarray, **limits: float) -> RayHits:
    """Compare with the same rays, each followed by its reverse, so that neighbors have nothing in common."""
    alone = np.repeat(origins, 2, axis=0), np.stack([directions, -directions], axis=1).reshape(-1, 3)
    found = surface.raycast(origins, directions, **limits)
    for one, other in zip(found, surface.raycast(*alone, **limits), strict=True):
        assert one.tobytes() == other[::2].tobytes()
    occluded = surface.occluded(origins, directions, **limits)
    np.testing.assert_array_equal(occluded, surface.occluded(*alone, **limits)[::2])
    return found


def camera(mesh: TriangleMesh, eye: np.ndarray, width: int, half_angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Rays from the eye toward the middle of the mesh, row by row."""
    ahead = mesh.bounds.mean(axis=0) - eye
    right = np.cross(ahead, [0.3, 1.0, 0.2])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead) / np.linalg.norm(ahead)
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, width) * np.tan(half_angle) * np.linalg.norm(ahead)] * 2)
    directions = ahead + x[..., None] * right + y[..., None] * up
    return np.tile(eye, (width**2, 1)), directions.reshape(-1, 3)


@pytest.mark.parametrize("away", [0.2, 1.5, 1e4, 1e8])
@pytest.mark.parametrize("name", SURFACES)
def test_cameras_see_what_single_rays_hit(name, away):
    surface = SURFACES[name]
    mesh = surface.mesh
    eye = mesh.bounds.mean(axis=0) + away * mesh.diagonal * np.array([0.6, 0.48, 0.64])
    rays = camera(mesh, eye, 83, 1.0 if away < 1 else np.arctan(0.5 / away))
    found = require_same_one_by_one(surface, *rays)
    assert name not in SOLIDS or (found.triangle_id >= 0).any()


@pytest.mark.parametrize("limits", [("t_min",), ("max_distance",), ("t_min", "max_distance")])
@pytest.mark.parametrize("name", SOLIDS)
def test_limits(name, limits):
    surface = SURFACES[name]
    eye = surface.mesh.bounds.mean(axis=0) + surface.mesh.diagonal * np.array([0.0, 0.0, 1.0])
    origins, directions = camera(surface.mesh, eye, 83, 0.5)
    free = surface.raycast(origins, directions)
    hit = free.triangle_id >= 0
    # Within the length of some rays and beyond that of others.
    lengths = free.t[hit] * np.linalg.norm(directions[hit], axis=1)
    reach = {"t_min": np.quantile(free.t[hit], 0.3), "max_distance": np.quantile(lengths, 0.7)}
    reach = {key: float(reach[key]) for key in limits}
    found = require_same_one_by_one(surface, origins, directions, **reach)
    assert (found.triangle_id >= 0).any()
    assert (found.triangle_id != free.triangle_id).any()


@pytest.mark.parametrize("zeros", [(0.0, 0.0), (-0.0, 0.0), (-0.0, -0.0), "mixed"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rays_along_an_axis(axis, zeros):
    # Through vertices, edges and faces of the box, whose tree has boxes without depth.
    surface = Surface(mesh_catalog.box(), device="cpu")
    steps = np.arange(-2, 131) / 128
    origins, directions = np.full((len(steps) ** 2, 3), 3.0), np.zeros((len(steps) ** 2, 3))
    u, v = (axis + 1) % 3, (axis + 2) % 3
    origins[:, u], origins[:, v] = (grid.ravel() for grid in np.meshgrid(steps, steps))
    directions[:, axis] = -1.0
    if zeros == "mixed":
        directions[:, [u, v]] = np.where(np.random.default_rng(51).random((len(origins), 2)) < 0.5, 0.0, -0.0)
    else:
        directions[:, [u, v]] = zeros
    found = require_same_one_by_one(surface, origins, directions)
    inside = ((origins >= 0.0) & (origins <= 1.0))[:, [u, v]].all(axis=1)
    np.testing.assert_array_equal(found.triangle_id >= 0, inside)
    np.testing.assert_array_equal(found.t[inside], 2.0)


@pytest.mark.parametrize("name", ["sphere", "torus"])
def test_rays_at_vertices_and_edges_do_not_leak(name):
    surface = SURFACES[name]
    mesh = surface.mesh
    a, b = mesh.vertices[mesh.faces].transpose(1, 0, 2)[:2]
    share = np.random.default_rng(52).random((len(a), 1))
    aims = np.concatenate([a, (a + b) / 2, a + share * (b - a)])
    # From inside, ordered by direction, so that neighbors visit the same nodes; the torus is hollow.
    eye = np.array([1.0, 0.0, 0.0]) if name == "torus" else np.array([0.1, 0.2, -0.1])
    way = aims - eye
    way /= np.abs(way).max(axis=1, keepdims=True)
    way = way[np.lexsort(np.round(way, 1).T)]
    origins = np.tile(eye, (len(way), 1))
    found = require_same_one_by_one(surface, origins, way)
    assert (found.triangle_id >= 0).all()


def test_few_rays_are_the_first_of_many():
    surface = SURFACES["sphere"]
    origins, directions = camera(surface.mesh, np.array([0.3, 0.1, 2.0]), 41, 0.5)
    first = 41 * 20
    many = surface.raycast(origins[first:], directions[first:])
    assert (many.triangle_id[:20] >= 0).any()
    for count in range(20):
        rays = slice(first, first + count)
        for one, other in zip(surface.raycast(origins[rays], directions[rays]), many, strict=True):
            assert one.tobytes() == other[:count].tobytes()


@settings(max_examples=of_all(30, 60), deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(SURFACES)), st.floats(-6, 0.5), st.floats(-6, 0.5))
def test_bundles(seed, name, width, angle):
    # Bundles of any width and angle: from rays that never diverge to rays without a common node.
    rng = np.random.default_rng(seed)
    surface = SURFACES[name]
    lower, upper = surface.mesh.bounds
    origins, directions = np.empty((30, 20, 3)), np.empty((30, 20, 3))
    origins[:] = rng.uniform(lower - 0.5, upper + 0.5, (30, 1, 3))
    directions[:] = rng.uniform(lower, upper, (30, 1, 3)) - origins
    origins += 10.0**width * rng.normal(size=origins.shape) * (upper - lower).max()
    directions += 10.0**angle * rng.normal(size=directions.shape) * np.abs(directions).max(axis=2, keepdims=True)
    require_same_one_by_one(surface, origins.reshape(-1, 3), directions.reshape(-1, 3))
