"""register on random shapes: invariances of the pose, and that it is rigid."""

from __future__ import annotations

import os
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geokit.points._register import register

# The first call of a process loads the kernels, which takes longer than any single example.
relaxed = settings(deadline=None, max_examples=25)
METHODS = st.sampled_from(["point_to_plane", "point_to_point"])
# Sums over a few hundred points of size 1, and as many steps as it takes.
EXACT = 1e-11


def shape(seed, count=500):
    """Points of a bumpy star-shaped surface and their normals, by differences."""
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    waves, phases = random.normal(size=(3, 3)) * 1.5, random.random(3) * 6.0

    def at(d):
        d = d / np.linalg.norm(d, axis=-1, keepdims=True)
        return d * (1.0 + 0.15 * np.sin(d @ waves.T + phases).sum(axis=-1, keepdims=True))

    across = np.cross(directions, np.roll(directions, 1, axis=1))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    step = 1e-6
    along = np.cross(directions, across)
    u = at(directions + step * across) - at(directions - step * across)
    v = at(directions + step * along) - at(directions - step * along)
    normals = np.cross(u, v)
    return at(directions), normals / np.linalg.norm(normals, axis=1, keepdims=True)


@st.composite
def poses(draw, angle=0.04, shift=0.03):
    """A small turn and shift, shape (4, 4)."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(random.uniform(-angle, angle, 3)).as_matrix()
    matrix[:3, 3] = random.uniform(-shift, shift, 3)
    return matrix


def moved(points, matrix):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.mark.slow
@relaxed
@given(st.integers(0, 99), poses(), METHODS)
def test_a_pose_is_recovered(seed, pose, method):
    points, normals = shape(seed)
    found = register(
        points, moved(points, pose), target_normals=normals @ pose[:3, :3].T, method=method, max_iterations=300,
        device="cpu",
    )  # fmt: skip
    np.testing.assert_allclose(found.transform, pose, atol=EXACT)
    assert (found.rank, found.converged, found.fitness) == (6, True, 1.0)


@relaxed
@given(st.integers(0, 99), poses(), METHODS, st.integers(1, 6))
def test_any_transform_is_rigid(seed, pose, method, steps):
    points, normals = shape(seed, 200)
    noise = np.random.default_rng(seed).normal(size=points.shape) * 0.05
    found = register(
        points + noise, moved(points, pose), target_normals=normals, method=method, max_iterations=steps, device="cpu"
    )
    rotation = found.transform[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) > 0.0
    assert found.transform[3].tolist() == [0.0, 0.0, 0.0, 1.0]


@pytest.mark.slow
@relaxed
@given(st.integers(0, 99), poses(), poses(3.0, 5.0), METHODS)
def test_moving_both_moves_the_pose(seed, pose, frame, method):
    points, normals = shape(seed, 300)
    target = moved(points, pose) + np.random.default_rng(seed).normal(size=points.shape) * 0.003
    options = {"method": method, "max_iterations": 3, "device": "cpu"}
    base = register(points, target, target_normals=normals, **options)
    other = register(moved(points, frame), moved(target, frame), target_normals=normals @ frame[:3, :3].T, **options)
    np.testing.assert_allclose(other.transform, frame @ base.transform @ np.linalg.inv(frame), atol=1e-9)
    assert other.rmse == pytest.approx(base.rmse, rel=1e-9)


@pytest.mark.slow
@relaxed
@given(st.integers(0, 99), poses(), st.sampled_from([2.0**-60, 2.0**-20, 2.0**20, 2.0**60]), METHODS)
def test_scale(seed, pose, scale, method):
    points, normals = shape(seed, 300)
    target = moved(points, pose)
    base = register(points, target, target_normals=normals, method=method, max_iterations=4, device="cpu")
    other = register(
        points * scale, target * scale, target_normals=normals, method=method, max_iterations=4, device="cpu"
    )
    np.testing.assert_allclose(other.transform[:3, :3], base.transform[:3, :3], atol=EXACT)
    np.testing.assert_allclose(other.transform[:3, 3] / scale, base.transform[:3, 3], atol=EXACT)
    assert other.rank == base.rank


@pytest.mark.slow
@relaxed
@given(st.integers(0, 99), poses(), METHODS)
def test_order_of_points(seed, pose, method):
    points, normals = shape(seed, 300)
    random = np.random.default_rng(seed)
    target = moved(points, pose) + random.normal(size=points.shape) * 0.003
    a, b = random.permutation(300), random.permutation(300)
    options = {"method": method, "max_iterations": 3, "device": "cpu"}
    base = register(points, target, target_normals=normals, **options)
    other = register(points[a], target[b], target_normals=normals[b], **options)
    np.testing.assert_allclose(other.transform, base.transform, atol=EXACT)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["point_to_plane", "point_to_point"])
def test_threads_change_no_bit(method):
    points, normals = shape(0, 20_000)
    target = points[::-1] + np.array([0.01, 0.02, 0.0])
    found = []
    for threads in ("1", "2", "3"):
        with mock.patch.dict(os.environ, {"GEOKIT_THREADS": threads}):
            found.append(
                register(points, target, target_normals=normals[::-1], method=method, max_iterations=4, device="cpu")
            )
    for other in found[1:]:
        np.testing.assert_array_equal(other.transform, found[0].transform)
        assert other[1:] == found[0][1:]
