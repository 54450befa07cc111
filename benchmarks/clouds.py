"""Clouds shared by the benchmarks of points; all random choices are seeded."""

from __future__ import annotations

import numpy as np

# Neighbors of a point on average.
NEIGHBORS = 30


def uniform(count: int) -> tuple[np.ndarray, float]:
    """Points in the unit cube, and the radius within which a point has about NEIGHBORS neighbors."""
    return np.random.default_rng(0).random((count, 3)), float((NEIGHBORS / (4.19 * count)) ** (1 / 3))


def clustered(count: int) -> tuple[np.ndarray, float]:
    """Half of the points in 1% of the volume; the radius gives NEIGHBORS on average, twice as many in that half."""
    random = np.random.default_rng(1)
    points = random.random((count, 3))
    points[: count // 2] *= 0.01 ** (1 / 3)
    points = points[random.permutation(count)]
    return points, float((2 * NEIGHBORS * 0.01 / (4.19 * 0.5 * count)) ** (1 / 3))


def plane(count: int) -> tuple[np.ndarray, float]:
    points = np.random.default_rng(2).random((count, 3))
    points[:, 2] = 0.0
    return points, float((NEIGHBORS / (np.pi * count)) ** 0.5)


def line(count: int) -> tuple[np.ndarray, float]:
    """Points along a diagonal."""
    return np.random.default_rng(3).random((count, 1)) * np.ones(3), NEIGHBORS * 3**0.5 / (2 * count)


SHAPES = {"uniform": uniform, "clustered": clustered, "plane": plane, "line": line}
