"""Normals and curvatures of a narrow band: how far from the surface they can be trusted, as the docstrings say."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog.float_grids import build_float_grid
from benchmarks.catalog.sphere_volumes import sphere_leaves
from geokit.volume._curvature import curvature
from geokit.volume.at_points.active import active_at
from geokit.volume.at_points.sample import gradient, sample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of

RADIUS = 30.0


def _band(half_width: float, voxel_size: float = 1.0, translation: float = 0.0) -> SparseVolume:
    """The narrow band of a sphere with a radius of 30 voxels."""
    origins, values, masks = sphere_leaves(RADIUS, half_width=half_width)
    transform = np.diag([voxel_size, voxel_size, voxel_size, 1.0])
    transform[:3, 3] = translation
    buffer = build_float_grid(
        origins,
        values * np.float32(voxel_size),
        masks,
        background=half_width * voxel_size,
        transform=transform,
        name="sphere",
        grid_class="level set",
        signed_fill=True,
    )
    return SparseVolume(buffer, info_of(buffer))


@pytest.fixture(scope="module")
def band():
    return _band(3.0)


@pytest.fixture(scope="module")
def directions():
    d = np.random.default_rng(0).normal(size=(10_000, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def _angles(volume, points, directions, order):
    slope = gradient(volume, points, order=order, device="cpu")
    cosine = (slope * directions).sum(axis=1) / np.linalg.norm(slope, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def _rms(values):
    return np.sqrt((values**2).mean())


# The figures of gradient()'s docstring: degrees rms up to a distance in voxels.
@pytest.mark.parametrize(
    ("order", "reach", "rms"),
    [
        *[(1, 0.0, 0.66), (1, 2.0, 0.67)],
        *[(2, 0.0, 0.013), (2, 1.0, 0.06), (2, 2.0, 0.8)],
        *[(3, 0.0, 0.007), (3, 1.0, 0.013), (3, 2.0, 0.4)],
    ],
)
def test_normals_of_a_band_of_half_width_3(band, directions, order, reach, rms):
    height = np.random.default_rng(1).uniform(-reach, reach, (len(directions), 1))
    assert _rms(_angles(band, directions * (RADIUS + height), directions, order)) < rms


@pytest.mark.parametrize("order", [1, 2, 3])
def test_normals_wherever_all_voxels_of_the_stencil_are_active(band, directions, order):
    height = np.random.default_rng(1).uniform(-3.0, 3.0, (len(directions), 1))
    points = directions * (RADIUS + height)
    base = np.floor(points)
    steps = np.array(list(np.ndindex(*3 * [order + 1]))) - (order > 1)
    inside = np.all([active_at(band, base + step, device="cpu") for step in steps], axis=0)
    assert inside.mean() > 0.2
    assert _rms(_angles(band, points[inside], directions[inside], order)) < 0.7
    assert _angles(band, points[inside], directions[inside], order).max() < 1.6


@pytest.mark.parametrize(("reach", "rms"), [(0.0, 0.012), (1.0, 0.02)])
def test_curvature_of_a_band_of_half_width_3(band, directions, reach, rms):
    height = np.random.default_rng(1).uniform(-reach, reach, (len(directions), 1))
    found = curvature(band, directions * (RADIUS + height), device="cpu")
    assert _rms(found.mean * (RADIUS + height[:, 0]) - 1) < rms


@pytest.mark.parametrize("order", [2, 3])
def test_wider_bands_reach_farther(directions, order):
    # Up to half_width less 2.5 voxels what a stencil sees beyond the band has next to no weight.
    for half_width in (4.0, 5.0, 6.0):
        volume = _band(half_width)
        reach = half_width - 2.5
        height = np.random.default_rng(1).uniform(-reach, reach, (len(directions), 1))
        points = directions * (RADIUS + height)
        assert _rms(_angles(volume, points, directions, order)) < 0.02
        error = sample(volume, points, order=order, device="cpu") - height[:, 0]
        assert np.abs(error).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("voxel_size", [1e-6, 1e-3, 1e3, 1e6])
@pytest.mark.parametrize("shift", [0.0, 1e6])
def test_neither_scale_nor_place_matters(directions, voxel_size, shift):
    volume = _band(3.0, voxel_size, shift * voxel_size)
    points = directions * RADIUS * voxel_size + shift * voxel_size
    for order, rms in ((1, 0.66), (2, 0.013), (3, 0.007)):
        assert _rms(_angles(volume, points, directions, order)) < rms
    found = curvature(volume, points, device="cpu")
    assert _rms(found.mean * RADIUS * voxel_size - 1) < 0.012


def test_a_level_set_from_a_mesh(directions):
    # The facets of an icosphere of 20480 triangles are off by up to 1 degree themselves.
    from benchmarks.catalog import mesh_catalog
    from geokit.volume.distance_fields.from_mesh import from_mesh

    mesh = mesh_catalog.icosphere(5)
    radius = float(np.linalg.norm(mesh.vertices[0]))
    volume = from_mesh(mesh, voxel_size=radius / 30, device="cpu")
    points = directions * radius
    for order in (1, 2, 3):
        assert _rms(_angles(volume, points, directions, order)) < 1.0
