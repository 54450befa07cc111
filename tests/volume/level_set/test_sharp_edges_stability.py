"""Erosion and opening of bodies in many poses: no pose is worse than the docstrings promise."""

from __future__ import annotations

import numpy as np
import pytest

from geokit import native
from geokit.volume._morphology import erode, opening
from tests.support.analytic_volumes import active_voxels, level_set
from tests.support.edged_bodies import cuboid, polygon, revolved, turned
from tests.support.effort import of_all

pytestmark = [pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB"), pytest.mark.slow]

HALF = np.array([11.0, 9.0, 8.0])
# What the docstring of opening promises, in voxels.
OPENED = 0.5


def worst(volume, true):
    points, values = active_voxels(volume)
    return np.abs(values - np.clip(true(points), -3.0, 3.0)).max()


def pose_and_distance(seed):
    rng = np.random.default_rng(seed)
    return (tuple(rng.uniform(-3.0, 3.0, 3)), tuple(rng.uniform(-0.5, 0.5, 3))), rng.uniform(0.5, 5.0)


@pytest.mark.parametrize("seed", range(of_all(2, 20)))
def test_boxes_in_random_poses(seed):
    pose, distance = pose_and_distance(seed)
    body, core = turned(cuboid(HALF), *pose), turned(cuboid(HALF - distance), *pose)
    assert worst(erode(level_set(body), distance), core) < 0.3
    assert worst(opening(level_set(body), distance), lambda p: core(p) - distance) < OPENED


@pytest.mark.parametrize("seed", range(20, of_all(21, 26)))
def test_cylinders_in_random_poses(seed):
    pose, distance = pose_and_distance(seed)

    def body(by):
        r, h = 10.0 - by, 9.0 - by
        return turned(revolved(polygon([(-r, -h), (r, -h), (r, h), (-r, h)])), *pose)

    assert worst(erode(level_set(body(0.0)), distance), body(distance)) < 0.3
    assert worst(opening(level_set(body(0.0)), distance), lambda p: body(distance)(p) - distance) < OPENED


@pytest.mark.parametrize("thickness", of_all([1.2], [1.2, 1.8, 2.4]))
def test_plates_that_stay_thin(thickness):
    pose = (0.31, 0.47, 0.73), (0.3, 0.2, -0.1)
    half = np.array([12.0, 11.0, 2.6 + thickness / 2])
    body, core = level_set(turned(cuboid(half), *pose)), turned(cuboid(half - 2.6), *pose)
    assert worst(erode(body, 2.6), core) < 0.3
    assert worst(opening(body, 2.6), lambda p: core(p) - 2.6) < OPENED


@pytest.mark.parametrize("seed", [239, 267])
def test_the_worst_openings_that_were_found(seed):
    rng = np.random.default_rng(seed)
    pose, distance = (tuple(rng.uniform(-3.0, 3.0, 3)), tuple(rng.uniform(-0.5, 0.5, 3))), rng.uniform(0.5, 6.0)
    half = rng.uniform(7.0, 12.0, 3)
    core = turned(cuboid(half - distance), *pose)
    assert worst(opening(level_set(turned(cuboid(half), *pose)), distance), lambda p: core(p) - distance) < OPENED
