"""Components whose bands meet, over gaps, directions and positions on the lattice, against each body alone."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.analytic_volumes import ball
from tests.support.two_bodies import cuboid, directions, errors

pytestmark = pytest.mark.slow

GAPS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 4.5, 5.0, 6.0)
# What the docstring of segment promises, in voxels: smooth bodies, boxes with wide gaps, boxes with narrow ones.
SMOOTH, EDGES, NARROW = 0.1, 0.4, 1.0


@pytest.mark.parametrize("gap", GAPS)
@pytest.mark.parametrize("radius", [6.0, 4.0])
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
