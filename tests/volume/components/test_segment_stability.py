"""Components whose bands meet, over gaps, directions and positions on the lattice, against each body alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.analytic_volumes import ball
from tests.support.effort import of_all
from tests.support.two_bodies import cuboid, directions, errors

pytestmark = pytest.mark.slow

# Those of the largest errors, narrow and wide.
GAPS = of_all((1.0, 3.0), (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 4.5, 5.0, 6.0))
# What the docstring of segment promises, in voxels: smooth bodies, boxes with wide gaps, boxes with narrow ones, and
# edges rounded by 3 or 4 voxels with narrow gaps.
SMOOTH, EDGES, NARROW, ROUNDED = 0.1, 0.5, 1.0, 0.5


@pytest.mark.parametrize("gap", GAPS)
@pytest.mark.parametrize("radius", of_all([4.0], [6.0, 4.0]))
def test_balls(gap, radius):
    rng = np.random.default_rng(int(10 * gap))
    for way in directions(2, rng):
        middle, reach = rng.uniform(-0.5, 0.5, 3), 6.0 + gap / 2.0
        bodies = [ball(6.0, tuple(middle - way * reach)), ball(radius, tuple(middle + way * (radius + gap / 2.0)))]
        assert max(errors(bodies)) < SMOOTH, (gap, way, middle)


@pytest.mark.parametrize("gap", GAPS)
def test_boxes(gap):
    rng = np.random.default_rng(100 + int(10 * gap))
    half = np.array([6.0, 5.0, 4.0])
    for axis in range(3):
        way = np.eye(3)[axis]
        middle, aside = rng.uniform(-0.5, 0.5, 3), rng.uniform(-4.0, 4.0, 3) * (1.0 - way)
        step = way * (half + gap / 2.0)
        bodies = [cuboid(half, middle - step), cuboid(half, middle + step + aside)]
        assert max(errors(bodies)) < (EDGES if gap >= 3.0 else NARROW), (gap, axis, middle, aside)


@pytest.mark.parametrize("gap", GAPS)
def test_a_box_and_a_ball(gap):
    rng = np.random.default_rng(200 + int(10 * gap))
    half = np.array([6.0, 5.0, 4.0])
    for axis in range(3):
        way = np.eye(3)[axis]
        middle, aside = rng.uniform(-0.5, 0.5, 3), rng.uniform(-2.0, 2.0, 3) * (1.0 - way)
        bodies = [cuboid(half, middle - way * (half + gap / 2.0)), ball(5.0, middle + way * (5.0 + gap / 2.0) + aside)]
        assert max(errors(bodies)) < (EDGES if gap >= 3.0 else NARROW), (gap, axis, middle, aside)


def turned_cuboid(half, center, turn, rounding):
    core = cuboid(np.array(half) - rounding, np.zeros(3))
    return lambda points: core((points - center) @ turn) - rounding


@pytest.mark.parametrize("gap", of_all([1.1, 4.5], [1.1, 1.8, 3.5, 4.5]))
@pytest.mark.parametrize("rounding", [0.0, 3.0, 4.0])
def test_turned_boxes(gap, rounding):
    half = (6.0, 5.0, 4.5)
    steps = np.arange(-12.0, 12.0, 0.6)
    around = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    for seed in range(of_all(1, 5)):
        rng = np.random.default_rng(7 * seed + int(10 * gap))
        one, other = (Rotation.random(random_state=seed + step).as_matrix() for step in (0, 50))
        way = directions(1, rng)[3]
        first = turned_cuboid(half, np.zeros(3), one, rounding)(around)
        near, far = 0.0, 30.0
        for _ in range(14):
            middle = (near + far) / 2.0
            # Along the shortest way between two bodies their distances add up to it.
            apart = (first + turned_cuboid(half, way * middle, other, rounding)(around)).min() >= gap
            near, far = (near, middle) if apart else (middle, far)
        bodies = [turned_cuboid(half, s * way * far / 2.0, turn, rounding) for s, turn in ((-1.0, one), (1.0, other))]
        wide = EDGES if rounding == 0.0 else SMOOTH
        narrow = NARROW if rounding == 0.0 else ROUNDED
        assert max(errors(bodies)) < (wide if gap >= 3.0 else narrow), (gap, rounding, seed)


@pytest.mark.parametrize("gap", of_all([1.1, 3.5], [1.1, 1.8, 2.5, 3.5]))
@pytest.mark.parametrize(("radius", "narrow"), [(4.0, SMOOTH), (3.0, ROUNDED)])
def test_tubes(gap, radius, narrow):
    def tube(middle, along):
        def distance(points):
            beside = points - middle - np.clip((points - middle) @ along, -5.0, 5.0)[:, None] * along
            return np.linalg.norm(beside, axis=1) - radius

        return distance

    for seed in range(of_all(1, 4)):
        rng = np.random.default_rng(seed + int(10 * gap))
        way, one, other = directions(3, rng)[3:]
        middle, reach = rng.uniform(-0.5, 0.5, 3), radius + gap / 2.0
        # Each runs across the way between them, so that the gap is the stated one.
        sides = [side / np.linalg.norm(side) for side in (np.cross(way, one), np.cross(way, other))]
        bodies = [tube(middle - way * reach, sides[0]), tube(middle + way * reach, sides[1])]
        assert max(errors(bodies)) < (SMOOTH if gap >= 3.0 else narrow), (gap, radius, seed)
