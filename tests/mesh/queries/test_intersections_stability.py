"""Intersections near the limits of float64: offsets, scales, slivers, planes that differ in the last bit."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from tests.support import reference


def surface(corners):
    mesh = gk.mesh.TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    return gk.mesh.Surface(mesh, device="cpu")


@pytest.mark.parametrize("scale", [1e-300, 1e-100, 1e-9, 1.0, 1e9, 1e100, 1e300])
def test_scales_do_not_change_the_pairs(scale):
    corners = np.random.default_rng(1).integers(0, 4, size=(12, 3, 3)).astype(float)
    power = 2.0 ** np.round(np.log2(scale))
    assert surface(corners * power).self_intersections().tolist() == reference.intersecting_pairs(corners)


@pytest.mark.parametrize("offset", [1.0, 1e4, 1e8, 1e15])
def test_offsets(offset):
    """Far out, corners snap to the float64 grid; the expected answer is that of the snapped corners."""
    corners = np.random.default_rng(2).random((14, 3, 3)) * 3.0 + offset
    assert surface(corners).self_intersections().tolist() == reference.intersecting_pairs(corners)


@pytest.mark.parametrize("aspect", [1e2, 1e4, 1e8, 1e12])
def test_slivers(aspect):
    rng = np.random.default_rng(3)
    corners = rng.random((16, 3, 3))
    corners[:, 2] = corners[:, 0] + 0.5 * (corners[:, 1] - corners[:, 0]) + rng.normal(size=(16, 3)) / aspect
    corners[::2] *= [1, 1, 0.1]
    found = surface(corners).self_intersections().tolist()
    assert found == reference.intersecting_pairs(corners)


@pytest.mark.parametrize("bits", [0, 1, 3, 10])
def test_nearly_coplanar(bits):
    rng = np.random.default_rng(4)
    corners = rng.random((16, 3, 3))
    corners[:, :, 2] = 0.3 * corners[:, :, 0] + 0.7 * corners[:, :, 1]
    corners[:, :, 2] += rng.integers(-bits, bits + 1, size=(16, 3)) * 2.0**-53
    found = surface(corners).self_intersections().tolist()
    assert found == reference.intersecting_pairs(corners)
    assert bits == 0 or 0 < len(found) < 120


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_smooth_meshes_stay_clean_far_out(offset):
    mesh = mesh_catalog.far_away(mesh_catalog.torus(192, 96), offset) if offset else mesh_catalog.torus(192, 96)
    assert len(gk.mesh.Surface(mesh, device="cpu").self_intersections()) == 0


def test_answers_do_not_depend_on_threads(monkeypatch):
    mesh = mesh_catalog.overlapping_spheres()
    expected = gk.mesh.Surface(mesh, device="cpu").self_intersections()
    monkeypatch.setenv("GEOKIT_THREADS", "1")
    np.testing.assert_array_equal(gk.mesh.Surface(mesh, device="cpu").self_intersections(), expected)
