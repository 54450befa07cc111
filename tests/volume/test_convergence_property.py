"""The whole way from a mesh to a sample: the error against an analytic distance falls with the square of the voxel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit import mesh, volume
from geokit.mesh import Surface

SAMPLE = Path(__file__).resolve().parents[2] / "data" / "samples" / "torus.ply"
MAJOR, MINOR = 1.0, 0.4  # the torus of data/samples


def torus_distance(points: np.ndarray) -> np.ndarray:
    ring = np.hypot(points[:, 0], points[:, 1]) - MAJOR
    return np.hypot(ring, points[:, 2]) - MINOR


def torus_gradient(points: np.ndarray) -> np.ndarray:
    radius = np.hypot(points[:, 0], points[:, 1])
    ring = radius - MAJOR
    length = np.hypot(ring, points[:, 2])
    return (
        np.stack([points[:, 0] / radius * ring, points[:, 1] / radius * ring, points[:, 2]], axis=1) / length[:, None]
    )


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    """Within 0.05 of the surface, and so 0.35 and more away from the medial axis (the ring, and the z axis)."""
    rng = np.random.default_rng(61)
    u, v = rng.uniform(0, 2 * np.pi, (2, 20_000))
    tube = MINOR + rng.uniform(-0.05, 0.05, 20_000)
    ring = MAJOR + tube * np.cos(v)
    return np.stack([ring * np.cos(u), ring * np.sin(u), tube * np.sin(v)], axis=1)


@pytest.mark.slow
def test_samples_converge_at_second_order(points):
    # 180,000 triangles: they stay within 9e-5 of the torus, a sixth of the smallest error below.
    surface = Surface(mesh_catalog.torus(450, 200, MAJOR, MINOR), device="cpu")
    errors, slopes = [], []
    for voxel in (0.12, 0.06, 0.03):
        sdf = volume.from_mesh(surface, voxel, half_width=4.0)
        errors.append(np.abs(sdf.sample(points, device="cpu") - torus_distance(points)).max())
        slopes.append(np.linalg.norm(sdf.gradient(points, device="cpu") - torus_gradient(points), axis=1).max())
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (orders > 1.7).all(), (errors, orders)
    assert errors[-1] < 8e-4
    # The gradient of a trilinear interpolant is one order behind.
    assert (np.log2(np.divide(slopes[:-1], slopes[1:])) > 0.8).all(), slopes


def test_the_sample_mesh_is_the_torus_it_says(points):
    torus = mesh.load(SAMPLE)
    distance = Surface(torus, device="cpu").signed_distance(points).distance
    assert np.abs(distance - torus_distance(points)).max() < 6e-4
    assert np.abs(torus_distance(torus.vertices)).max() < 1e-12
