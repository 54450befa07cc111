"""register pushed towards failure: far from the origin, noise, overlap, ever farther starts, shapes that slide."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.points._register import register

METHODS = ["point_to_plane", "point_to_point"]


def blob(count=2000, seed=0, axes=(1.0, 0.7, 0.45)):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    normals = points / np.asarray(axes)
    return points * axes, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def rotation_of(angle, axis=(1.0, 2.0, -1.0)):
    return Rotation.from_rotvec(angle * np.asarray(axis) / np.linalg.norm(axis)).as_matrix()


def apply(found, points):
    return points @ found.transform[:3, :3].T + found.transform[:3, 3]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("offset", [0.0, 1e3, 1e6, 1e9])
def test_far_from_the_origin(method, offset):
    points, normals = blob()
    rotation = rotation_of(0.03)
    source = points + offset
    target = points @ rotation.T + [0.02, -0.01, 0.01] + offset
    found = register(
        source, target, target_normals=normals @ rotation.T, method=method, max_iterations=200, device="cpu"
    )
    # A few roundings of the coordinates: the rotation's own are multiplied by them.
    assert np.abs(apply(found, source) - target).max() <= 1e-12 + 8.0 * offset * 2.0**-53
    assert np.abs(found.transform[:3, :3] - rotation).max() <= 1e-12 + 8.0 * offset * 2.0**-53
    assert (found.converged, found.rank) == (True, 6)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [1e-100, 1e-8, 1e8, 1e100])
def test_scales(method, scale):
    points, normals = blob(800)
    rotation = rotation_of(0.03)
    target = points @ rotation.T + [0.02, -0.01, 0.01]
    found = register(
        points * scale, target * scale, target_normals=normals @ rotation.T, method=method, max_iterations=200,
        device="cpu",
    )  # fmt: skip
    np.testing.assert_allclose(apply(found, points * scale) / scale, target, atol=1e-12)
    assert (found.converged, found.rank) == (True, 6)


@pytest.mark.parametrize("noise", [1e-6, 1e-4, 1e-2])
def test_noise(noise):
    # Six unknowns from 4000 noisy planes leave a share of sqrt(6 / 4000) = 0.04 of the noise; partners that the noise
    # has exchanged leave as much again. Measured 0.07.
    points, normals = blob(4000)
    rotation = rotation_of(0.03)
    target = points @ rotation.T + [0.02, -0.01, 0.01]
    source = points + np.random.default_rng(1).normal(size=points.shape) * noise
    found = register(source, target, target_normals=normals @ rotation.T, device="cpu")
    assert np.sqrt(np.mean((apply(found, points) - target) ** 2)) < 0.12 * noise


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("overlap", [0.9, 0.7, 0.5])
def test_partial_overlap(method, overlap):
    # Each half lacks the part of the other beyond a plane. A distance of three spacings excludes the rest.
    points, normals = blob(6000)
    order = np.argsort(points[:, 0])
    count = int(len(points) * (1.0 + overlap) / 2.0)
    low, high = order[:count], order[-count:]
    rotation = rotation_of(0.01)
    target = points @ rotation.T + [0.005, -0.004, 0.003]
    found = register(
        points[low], target[high], target_normals=(normals @ rotation.T)[high], method=method, max_distance=0.06,
        max_iterations=400, device="cpu",
    )  # fmt: skip
    assert found.fitness == pytest.approx(overlap * 2.0 / (1.0 + overlap), abs=0.08)
    # At the rim points of the missing part find a neighbor instead, 0.03 away; planes there are the right ones yet.
    assert np.abs(apply(found, points[low]) - target[low]).max() < (1e-3 if method == "point_to_plane" else 4e-3)


@pytest.mark.parametrize("angle", [0.05, 0.2, 0.4, 0.6, 0.8, 1.0])
def test_starts_farther_and_farther_away(angle):
    # An ellipsoid of axes 1, 0.7 and 0.45 finds back from 57 degrees and a third of its length.
    points, normals = blob(3000)
    rotation = rotation_of(angle)
    target = points @ rotation.T + np.array([0.3, -0.2, 0.2]) * angle
    found = register(points, target, target_normals=normals @ rotation.T, device="cpu")
    np.testing.assert_allclose(apply(found, points), target, atol=1e-12)
    assert found.iterations <= 10


def test_a_start_too_far_away_ends_somewhere_else_and_says_so():
    points, normals = blob(3000)
    rotation = rotation_of(2.0)
    found = register(points, points @ rotation.T, target_normals=normals @ rotation.T, device="cpu")
    # Turned half way round an axis the ellipsoid is the same shape, but not the same points: rmse shows it.
    assert found.rmse > 0.02


@pytest.mark.parametrize("thickness", [1e-2, 1e-4, 1e-6, 1e-7, 1e-8, 0.0])
def test_flat_shapes_stay_where_they_are_along_themselves(thickness):
    random = np.random.default_rng(0)
    flat = random.random((1500, 3)) * [1.0, 1.0, 0.0]
    x, y = 7.0 * flat[:, 0], 5.0 * flat[:, 1]
    target = flat + (thickness * np.sin(x) * np.sin(y))[:, None] * [0.0, 0.0, 1.0]
    slope_x, slope_y = 7.0 * thickness * np.cos(x) * np.sin(y), 5.0 * thickness * np.sin(x) * np.cos(y)
    normals = np.stack([-slope_x, -slope_y, np.ones(1500)], axis=1)
    start = target + np.array([0.001, 0.002, 0.01])
    found = register(start, target, target_normals=normals, device="cpu")
    off = apply(found, start) - target
    # Slopes of a millionth are followed along the surface; below, the shift along it stays as it was.
    assert (found.rank, found.converged) == (6 if thickness >= 1e-6 else 3, True)
    if found.rank == 6:
        np.testing.assert_allclose(off, 0.0, atol=1e-13)
    else:
        np.testing.assert_allclose(off[:, :2], np.tile([0.001, 0.002], (1500, 1)), atol=1e-8)
        np.testing.assert_allclose(off[:, 2], 0.0, atol=thickness)


@pytest.mark.parametrize("voxel_size", [0.1, 0.05, 0.025])
def test_a_level_set_is_as_good_as_its_voxels(voxel_size):
    mesh = mesh_catalog.torus()
    mesh = gk.mesh.TriangleMesh(mesh.vertices * [1.0, 1.2, 0.8], mesh.faces)
    points = gk.mesh.sample_surface(mesh, 3000, seed=1).points
    rotation = rotation_of(0.02)
    sdf = gk.volume.from_mesh(mesh, voxel_size, half_width=4.0, device="cpu")
    found = register((points - [0.01, -0.01, 0.01]) @ rotation, sdf, device="cpu")
    # Interpolated planes are off by second order, here an eighth of voxel^2 over the radius of 0.28, less than a tenth
    # of which is left on average.
    bound = 0.1 * voxel_size**2 / 0.28
    assert np.abs(apply(found, (points - [0.01, -0.01, 0.01]) @ rotation) - points).max() < bound


def test_duplicates_and_single_points():
    points, normals = blob(300)
    doubled = np.repeat(points, 3, axis=0)
    found = register(doubled + 0.01, doubled, target_normals=np.repeat(normals, 3, axis=0), device="cpu")
    np.testing.assert_allclose(apply(found, doubled + 0.01), doubled, atol=1e-12)
    assert register([[0, 0, 0]] * 3, [[1.0, 2.0, 3.0]], method="point_to_point", device="cpu").rmse == 0.0
