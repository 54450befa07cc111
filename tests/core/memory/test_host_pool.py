"""Results of CPU kernels in memory that has been used before, and never in memory that somebody holds."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit.core.memory import host_pool
from geokit.core.memory.host_pool import KEPT_BYTES, SMALLEST_BYTES, empty, empty_warp

COUNT = 1 << 19


def address(array):
    return array.__array_interface__["data"][0]


@pytest.fixture(autouse=True)
def nothing_kept(monkeypatch):
    pool = host_pool.MemoryPool(
        host_pool._pages, most_bytes=KEPT_BYTES, largest_bytes=KEPT_BYTES, smallest_bytes=SMALLEST_BYTES
    )
    monkeypatch.setattr(host_pool, "_pool", pool)


def test_memory_is_used_again():
    first = empty((COUNT,), np.float64)
    place = address(first)
    del first
    again = empty((COUNT // 4, 3), np.float64)
    assert address(again) == place
    assert again.shape == (COUNT // 4, 3)
    assert again.dtype == np.float64


@pytest.mark.slow
@pytest.mark.parametrize(
    "hold",
    [
        lambda a: a,
        lambda a: a[5:9],
        lambda a: a.view(np.int64).reshape(-1, 2)[:, 1].view(np.float64),
        lambda a: np.asarray(memoryview(a)[3:4]),
        lambda a: np.from_dlpack(a),
        lambda a: wp.array(a, dtype=wp.float64, device="cpu", copy=False)[10:20],
    ],
)
def test_what_is_held_is_not_given_away(hold):
    first = empty((COUNT,), np.float64)
    first.fill(7.0)
    place = address(first)
    held = hold(first)
    del first
    gc.collect()
    others = [empty((COUNT,), np.float64) for _ in range(3)]
    assert len({place, *map(address, others)}) == 4
    for other in others:
        other.fill(1.0)
    np.testing.assert_array_equal(held.numpy() if isinstance(held, wp.array) else held, 7.0)


@pytest.mark.slow
def test_arrays_of_kernels_hold_it():
    array = empty_warp(COUNT, wp.float32, wp.get_device("cpu"))
    place, part = array.ptr, array[7:9]
    del array
    gc.collect()
    assert address(empty((COUNT,), np.float32)) != place
    del part
    gc.collect()
    assert place in [address(a) for a in [empty((COUNT,), np.float32) for _ in range(3)]]


@pytest.mark.parametrize("count", [0, 1, SMALLEST_BYTES - 1, KEPT_BYTES + 1])
def test_other_sizes_are_numpys(count):
    assert empty((count,), np.uint8).shape == (count,)
    assert not host_pool._pool._bytes


@pytest.mark.slow
def test_lists_that_are_held_stay_as_they_are():
    points = np.random.default_rng(3).uniform(0.0, 1.0, (60_000, 3))
    grid = gk.points.NeighborGrid(points, 0.05, device="cpu")
    first = grid.radius_search()
    copies = [np.array(part) for part in first]
    for radius in (0.04, 0.045, 0.05):
        grid.radius_search(radius=radius)
    for part, copy in zip(first, copies, strict=True):
        np.testing.assert_array_equal(part, copy)
