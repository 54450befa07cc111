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
# A gradient is a difference of such values over a voxel of 0.04.
SINGLE_SLOPE = 1e-4
# Indices up to 40 in float32, and some more for the transform.
SINGLE_INDEX = 1e-4


def run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return run_block(PAGE, name, tmp_path, monkeypatch)


def test_every_block_is_checked():
    assert set(blocks_of(PAGE)) == {"mesh", "volume", "grid", "moving", "team", "all"}


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+)\)", PAGE.read_text(encoding="utf-8")):
        assert (ROOT / "docs" / target).exists(), target


def test_mesh(tmp_path, monkeypatch):
    page = run("mesh", tmp_path, monkeypatch)
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


def test_mesh_far_from_the_origin(tmp_path, monkeypatch):
    # What the page promises of the frame: the same kernel, the same accuracy, a million away.
    page = run("mesh", tmp_path, monkeypatch)
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
    single = page.points.astype(np.float32).astype(np.float64)
    np.testing.assert_allclose(page.distance.numpy(), page.sdf.sample(single), atol=SINGLE)
    # The gradient of the interpolant jumps at the faces of cells, where float32 may see the other side.
    index = single / float(page.sdf.info.voxel_size[0])
    inner = (np.abs(index - np.rint(index)) > SINGLE_INDEX).all(axis=1)
    assert inner.mean() > 0.99
    gradient = page.sdf.gradient(single)
    np.testing.assert_allclose(page.gradient.numpy()[inner], gradient[inner], atol=SINGLE_SLOPE)
    assert np.median(np.linalg.norm(gradient, axis=1)) > 0.9


def test_grid(tmp_path, monkeypatch):
    page = run("grid", tmp_path, monkeypatch)
    found = page.grid.radius_search(page.points)
    # Nobody sits so close to the radius that float32 could see it on the other side.
    near = page.grid.radius_search(page.points, radius=0.1 + 1e-6)
    assert len(near.indices) == len(found.indices)
    assert found.distance.max() < 0.1 - 1e-8
    np.testing.assert_array_equal(page.count.numpy(), np.diff(found.offsets))
    total = np.add.reduceat(page.points[found.indices, 2], found.offsets[:-1])
    np.testing.assert_allclose(page.mean.numpy(), total / np.diff(found.offsets), atol=SINGLE)


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
    p = page.points.astype(np.float32).astype(np.float64)
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
    # Beside a ridge of the mesh, or for a ball on it, float32 may push to the other side; so few that none is here.
    np.testing.assert_allclose(page.push.numpy(), expected, atol=SINGLE_SLOPE)
