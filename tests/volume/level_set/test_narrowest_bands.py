"""Bands of one voxel whose surface lies on the lattice: corners of crossed cells are as far as the band is wide."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from geokit.mesh import box

SIDE, VOXEL = 2.0, 0.1


@pytest.fixture(scope="module")
def narrow() -> gk.volume.SparseVolume:
    return gk.volume.from_mesh(box((SIDE,) * 3), VOXEL, half_width=1.0, device="cpu")


def exact(points: np.ndarray, half: float = SIDE / 2.0) -> np.ndarray:
    beyond = np.abs(points) - half
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


@pytest.mark.parametrize("voxel_size", [0.05, 0.1, 0.13, 0.17, 0.2])
def test_a_body_that_is_sampled_anew_keeps_its_inside(narrow: gk.volume.SparseVolume, voxel_size: float) -> None:
    found = gk.volume.resample(narrow, voxel_size=voxel_size)
    points = np.random.default_rng(0).uniform(-1.4, 1.4, (4000, 3))
    points = points[np.abs(exact(points)) > voxel_size]
    assert np.array_equal(gk.volume.sample(found, points, device="cpu") < 0.0, exact(points) < 0.0)


@pytest.mark.parametrize("distance", [-0.25, -0.1, 0.15])
def test_its_surface_moves_as_far_as_asked(narrow: gk.volume.SparseVolume, distance: float) -> None:
    wide = gk.volume.from_mesh(box((SIDE,) * 3), VOXEL, half_width=4.0, device="cpu")
    volumes = [gk.mesh.from_volume(gk.volume.offset(each, distance), device="cpu").volume for each in (narrow, wide)]
    assert volumes[0] == pytest.approx(volumes[1], rel=0.02)


def test_a_wider_band_has_the_distances(narrow: gk.volume.SparseVolume) -> None:
    wide = gk.volume.from_mesh(box((SIDE,) * 3), VOXEL, half_width=3.0, device="cpu")
    joined = gk.volume.union(wide, narrow)
    voxels = gk.volume.active_voxels(joined)
    off = np.abs(voxels.values - exact(voxels.coordinates * VOXEL)) / VOXEL
    assert off.max() < 0.85
    assert np.mean(off > 0.1) < 0.08
    inside = exact(voxels.coordinates * VOXEL) < -1e-9
    assert off[inside].max() < 0.02
