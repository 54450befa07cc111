"""The order of queries on a CPU: that of one stable sort by Morton keys, for any number of threads."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.core import launcher
from geokit.core.memory.host_array import HostArray

LOWER, EXTENT = np.array([-2.0, -2.0, -2.0]), 4.0


def expected(points: np.ndarray, extent: float = EXTENT) -> np.ndarray:
    inverse = 1.0 / extent if extent > 0.0 else 0.0
    with np.errstate(invalid="ignore"):
        cells = (np.nan_to_num(np.clip((points - LOWER) * inverse, 0.0, 1.0), nan=0.0) * 1023.0).astype(np.int64)
    keys = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            keys |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(keys, kind="stable")


def found(points: np.ndarray, extent: float = EXTENT) -> np.ndarray:
    device = launcher.resolve_device("cpu")
    return launcher.morton_order(HostArray(points), LOWER, extent, device).numpy()[: len(points)]


@pytest.mark.parametrize("threads", ["1", "2", "3"])
@pytest.mark.parametrize("count", [launcher.MINIMUM_ORDERED, 5003, 100_000])
@pytest.mark.parametrize("kind", ["everywhere", "one corner", "one place", "lattice"])
def test_the_order_is_that_of_a_stable_sort(threads, count, kind, monkeypatch):
    """Buckets of no points, of few, of many, and of all."""
    monkeypatch.setenv("GEOKIT_THREADS", threads)
    monkeypatch.setattr(launcher, "ORDER_SHARE", 1 << 12)
    rng = np.random.default_rng(count)
    points = {
        "everywhere": rng.random((count, 3)) * 5.0 - 2.5,
        "one corner": rng.random((count, 3)) ** 8 - 2.0,
        "one place": np.zeros((count, 3)),
        "lattice": np.round(rng.random((count, 3)) * 3.0),
    }[kind]
    np.testing.assert_array_equal(found(points), expected(points))


def test_points_that_are_not_finite_have_a_place():
    """Searches see them later and name them."""
    points = np.random.default_rng(0).random((5000, 3))
    points[::7, 1] = np.inf
    points[::11, 2] = -np.inf
    points[::13, 0] = np.nan
    np.testing.assert_array_equal(found(points), expected(points))


def test_a_box_without_extent_keeps_the_order():
    points = np.random.default_rng(0).random((3000, 3))
    np.testing.assert_array_equal(found(points, 0.0), np.arange(3000))


def test_few_points_keep_their_order():
    points = np.random.default_rng(0).random((launcher.MINIMUM_ORDERED - 1, 3))
    np.testing.assert_array_equal(found(points), np.arange(len(points)))
