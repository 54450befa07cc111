"""A tolerance on the surface alone, or next to it: what is checked lies there, also where the voxels are much wider."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.volume.tolerance.zone import FEW, THIN, Zone
from tests.support import reference
from tests.support.effort import of_all


def on_surface(mesh, count, seed=0):
    """Points of faces and edges, and all vertices."""
    rng = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces]
    inner = np.einsum("nfk,fkd->nfd", rng.dirichlet([1, 1, 1], (count, len(corners))), corners)
    t = rng.uniform(size=(count, len(corners), 1))
    edges = [corners[:, k] * t + corners[:, (k + 1) % 3] * (1.0 - t) for k in range(3)]
    return np.concatenate([inner.reshape(-1, 3), *(edge.reshape(-1, 3) for edge in edges), mesh.vertices])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "seed"),
    [("from_mesh", 0), ("adaptive_from_mesh", 3), *of_all([], [("from_mesh", 3), ("adaptive_from_mesh", 0)])],
)
def test_on_the_surface_the_tolerance_holds_at_edges_and_vertices_too(make, seed):
    """Nearly no point that is moved about stays on the surface: edges were up to 1.1 tolerances off."""
    mesh = mesh_catalog.turned(mesh_catalog.l_profile(), seed)
    tolerance = 0.01 * float(np.ptp(mesh.vertices, axis=0).max())
    options = {"within": 0.0, "order": 2, "codec": "fp8", "device": "cpu"}
    if make == "from_mesh":
        field = gk.volume.from_mesh(mesh, tolerance=tolerance, **options)
        achieved, order = field.info.achieved_error, {"order": 2}
    else:
        field = gk.volume.adaptive_from_mesh(mesh, tolerance, **options)
        achieved, order = field.achieved_error, {}
    assert 0.0 < achieved <= tolerance
    errors = np.abs(field.sample(on_surface(mesh, 1000), device="cpu", **order))
    assert errors.max() <= tolerance
    # The stated error is the largest, not that of the few points that rounding left on the surface.
    assert errors.max() <= 1.03 * achieved


@pytest.mark.slow
@pytest.mark.parametrize("within", [0.0, 1e-6])
def test_a_shell_may_be_asked_for_on_its_surface_alone(within):
    """No random direction leads to it: that was an error of NumPy, or a check of next to no points."""
    mesh = gk.mesh.torus(segments=24, tube_segments=12)
    field = gk.volume.from_mesh(
        mesh, tolerance=0.01, thickness=0.1, within=within, order=1, codec="float", device="cpu"
    )
    assert 0.005 < field.info.achieved_error <= 0.01
    found = gk.mesh.sample_surface(mesh, 3000, seed=3)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[found.triangle_id]], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.concatenate([found.points + side * 0.05 * normals for side in (-1.0, 1.0)])
    exact = reference.closest_point(mesh.vertices, mesh.faces, points).distance - 0.05
    there = np.abs(exact) < 1e-12
    assert there.sum() > 3000
    assert np.abs(field.sample(points, order=1, device="cpu") - exact)[there].max() <= 0.01


def test_points_of_a_thick_zone_are_taken_as_they_are():
    def never(points):
        raise AssertionError("asked for the surface")

    ball = Zone(
        lambda p: np.linalg.norm(p, axis=1) - 1.0, lambda n, s: np.zeros((n, 3)), never,
        np.array([[-1.0] * 3, [1.0] * 3]), 0.05, 0.0,
    )  # fmt: skip
    points = np.random.default_rng(0).normal(size=(500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    moved = ball.moved(points, 0.5, np.random.default_rng(1))
    near, exact = ball.near(moved, 0.5, np.random.default_rng(1))
    kept, kept_exact = ball.kept(moved)
    assert 0 < len(kept) < 500
    np.testing.assert_array_equal(near, kept)
    np.testing.assert_array_equal(exact, kept_exact)


def test_points_are_brought_back_into_a_thin_zone():
    ball = Zone(
        lambda p: np.linalg.norm(p, axis=1) - 1.0, lambda n, s: np.zeros((n, 3)),
        lambda p: p / np.linalg.norm(p, axis=1, keepdims=True), np.array([[-1.0] * 3, [1.0] * 3]), 1e-4, 0.0,
    )  # fmt: skip
    points = np.random.default_rng(0).normal(size=(500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    random = np.random.default_rng(1)
    near, exact = ball.near(ball.moved(points, 0.5, random), 0.5, random)
    assert len(near) == 500
    assert np.abs(exact).max() <= 1e-4 * (1.0 + 1e-9)
    assert np.abs(exact).max() > 5e-5


def test_points_are_brought_back_where_few_directions_lead_into_the_zone():
    """A shell of a ball: it is as thick as what is reached straight up and down, and nowhere else."""
    zone = Zone(
        lambda p: np.abs(np.linalg.norm(p, axis=1) - 1.0) - 0.5, lambda n, s: np.zeros((n, 3)),
        lambda p: p * ((1.0 + 0.5 * np.sign(np.linalg.norm(p, axis=1) - 1.0)) / np.linalg.norm(p, axis=1))[:, None],
        np.array([[-1.0] * 3, [1.0] * 3]), 0.004, 0.5,
    )  # fmt: skip
    assert zone.within > THIN * zone.offset
    points = np.random.default_rng(0).normal(size=(500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    random = np.random.default_rng(1)
    moved = zone.moved(points, zone.within, random, zone.offset)
    assert 0 < len(zone.kept(moved)[0]) < FEW * 500
    near, exact = zone.near(moved, zone.offset, random)
    assert len(near) == 500
    assert np.abs(exact).max() <= zone.within * (1.0 + 1e-9)
