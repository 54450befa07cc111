"""Every program on the page about the user's own kernels runs, and agrees with geokit's own queries."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import geokit as gk
from tests.support import reference
from tests.support.page_blocks import blocks_of, run_block

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "kernels.md"
# Coordinates up to 1.5 in float32, through some ten operations each rounded at 6e-8.
SINGLE = 2e-6
# Sums of float64 in another order.
EXACT = 1e-13


def run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return run_block(PAGE, name, tmp_path, monkeypatch)


def test_every_block_is_checked():
    assert set(blocks_of(PAGE)) == {"mesh", "rays", "volume", "grid", "moving", "team", "graph", "all", "handle"}


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+)\)", PAGE.read_text(encoding="utf-8")):
        assert (ROOT / "docs" / target).exists(), target


def test_mesh(tmp_path, monkeypatch):
    page = run("mesh", tmp_path, monkeypatch)
    found = page.surface.signed_distance(page.points)
    inside = found.distance < 0.0
    np.testing.assert_array_equal(page.depth.numpy(), np.where(inside, -found.distance, 0.0))
    np.testing.assert_array_equal(page.projected.numpy(), np.where(inside[:, None], found.points, page.points))
    assert 0 < inside.sum() < 1000


def test_rays(tmp_path, monkeypatch):
    page = run("rays", tmp_path, monkeypatch)
    # Other random directions: a share of 64 has a standard deviation of at most 1/16.
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(500, 256, 3))
    directions *= np.sign(np.einsum("ijk,ik->ij", directions, page.normals))[..., None]
    origins = np.repeat(page.spots.points, 256, axis=0)
    blocked = page.surface.occluded(origins, directions.reshape(-1, 3), t_min=1e-9).reshape(500, 256)
    found = page.openness.numpy()
    assert np.abs(found - (1.0 - blocked.mean(axis=1))).max() < 0.4
    assert abs(found.mean() - (1.0 - blocked.mean())) < 0.01
    assert found.min() < 0.7
    assert found.max() == 1.0


def test_graph(tmp_path, monkeypatch):
    page = run("graph", tmp_path, monkeypatch)
    before = page.surface.closest_point(page.start)
    # Each step leaves nine tenths of the way, to the same point.
    expected = before.points + 0.9**40 * (page.start - before.points)
    np.testing.assert_allclose(page.points.numpy(), expected, atol=1e-9)


def test_handle(tmp_path, monkeypatch):
    page = run("handle", tmp_path, monkeypatch)
    found = page.surface.closest_point(page.points)
    np.testing.assert_allclose(page.distance.numpy(), found.distance, atol=SINGLE)
    # Where two triangles are equally near, float32 may take the other one: it is as near as that.
    triangle = page.triangle.numpy()
    for row in range(0, 1000, 10):
        face = page.torus.faces[triangle[row : row + 1]]
        nearest = reference.closest_point(page.torus.vertices, face, page.points[row : row + 1]).distance[0]
        assert abs(nearest - found.distance[row]) < SINGLE


@pytest.mark.parametrize("threads", ["1", "3"])
def test_team(tmp_path, monkeypatch, threads):
    monkeypatch.setenv("GEOKIT_THREADS", threads)
    page = run("team", tmp_path, monkeypatch)
    expected = page.start
    for _ in range(100):
        padded = np.pad(expected, 1, mode="edge")
        expected = np.float32(0.5) * expected + np.float32(0.25) * (padded[:-2] + padded[2:])
    np.testing.assert_allclose(page.values.numpy()[0], expected, atol=SINGLE)


def test_handle_far_from_the_origin(tmp_path, monkeypatch):
    # What the page promises of the frame: the same kernel, the same accuracy, a million away.
    page = run("handle", tmp_path, monkeypatch)
    import warp as wp

    away = np.array([1e6, -2e6, 3e6])
    surface = gk.mesh.Surface(
        gk.mesh.TriangleMesh(page.torus.vertices + away, page.torus.faces), device=page.surface.device
    )
    points = wp.array(page.points + away, dtype=wp.vec3d, device=surface.device)
    inputs = [wp.uint64(surface.id), wp.vec3d(*surface.origin), wp.float64(surface.scale), points]
    distance = wp.empty_like(page.distance)
    wp.launch(page.closest_kernel, 1000, inputs=inputs, outputs=[distance, page.triangle], device=surface.device)
    np.testing.assert_allclose(distance.numpy(), surface.closest_point(page.points + away).distance, atol=SINGLE)


def test_volume(tmp_path, monkeypatch):
    page = run("volume", tmp_path, monkeypatch)
    sdf, points = page.sdf, page.points
    np.testing.assert_array_equal(page.distance.numpy(), sdf.sample(points, device=page.device))
    for _ in range(3):
        slope = sdf.gradient(points)
        points = points - (sdf.sample(points) / np.maximum((slope * slope).sum(axis=1), 1e-9))[:, None] * slope
    np.testing.assert_allclose(page.moved.numpy(), points, atol=1e-9)
    assert np.abs(sdf.sample(page.moved.numpy())).max() < 1e-4


def test_grid(tmp_path, monkeypatch):
    page = run("grid", tmp_path, monkeypatch)
    found = page.grid.radius_search(page.points)
    np.testing.assert_array_equal(page.count.numpy(), np.diff(found.offsets))
    total = np.add.reduceat(page.points[found.indices, 2], found.offsets[:-1])
    np.testing.assert_allclose(page.mean.numpy(), total / np.diff(found.offsets), atol=EXACT)


@pytest.mark.slow
def test_moving(tmp_path, monkeypatch):
    page = run("moving", tmp_path, monkeypatch)
    points = np.random.default_rng(4).uniform(0.0, 1.0, (2000, 3))
    for _ in range(10):
        away = points[:, None] - points
        distance = np.linalg.norm(away, axis=2)
        np.fill_diagonal(distance, np.inf)
        share = np.where(distance < 0.1, 0.02 * (0.1 / distance - 1.0), 0.0)
        points = points + (share[:, :, None] * away).sum(axis=1)
    np.testing.assert_allclose(page.points.numpy(), points, atol=1e-12)


def test_all_three(tmp_path, monkeypatch):
    page = run("all", tmp_path, monkeypatch)
    p = page.points
    expected = np.zeros_like(p)

    found = page.grid.radius_search(p, radius=2.0 * page.radius)
    rows = np.repeat(np.arange(len(p)), np.diff(found.offsets))
    apart = p[rows] - p[found.indices]
    gap = np.linalg.norm(apart, axis=1)
    pairs = rows != found.indices
    pushes = 0.5 * (2.0 * page.radius - gap[pairs, None]) * apart[pairs] / gap[pairs, None]
    np.add.at(expected, rows[pairs], pushes)

    closest = page.surface.closest_point(p, max_distance=page.radius)
    touched = closest.triangle_id >= 0
    away = (p - closest.points)[touched]
    length = np.linalg.norm(away, axis=1, keepdims=True)
    expected[touched] += (page.radius - length) * away / length

    distance, slope = page.room.sample(p), page.room.gradient(p)
    out = distance > -page.radius
    expected[out] -= (distance[out] + page.radius)[:, None] * slope[out] / np.linalg.norm(slope[out], axis=1)[:, None]

    assert pairs.sum() > 1000
    assert touched.sum() > 200
    assert out.sum() >= 20
    np.testing.assert_allclose(page.push.numpy(), expected, atol=EXACT)
