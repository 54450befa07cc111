"""Memory of results that nobody holds any more serves the next ones, and no other memory does."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import warp as wp

from geokit import _kept_memory
from geokit._host_array import HostArray

COUNT = 1 << 19


@pytest.fixture(autouse=True)
def nothing_kept(monkeypatch):
    monkeypatch.setattr(_kept_memory, "_kept", [])


def address(array):
    return array.__array_interface__["data"][0]


def test_memory_is_used_again():
    first = _kept_memory.empty(COUNT, np.float64)
    place = address(first)
    del first
    again = _kept_memory.empty(COUNT - 1000, np.float64)
    assert address(again) == place
    assert again.shape == (COUNT - 1000,)
    assert again.dtype == np.float64
    assert again.flags.c_contiguous
    assert again.flags.writeable


@pytest.mark.parametrize("holder", ["array", "slice", "view", "memoryview", "warp"])
def test_what_is_held_is_not_given_away(holder):
    first = _kept_memory.empty(COUNT, np.float64)
    first.fill(7.0)
    place = address(first)
    held = {
        "array": lambda a: a,
        "slice": lambda a: a[5:9],
        "view": lambda a: a.view(np.int64).reshape(-1, 2)[:, 1],
        "memoryview": lambda a: memoryview(a)[3:4],
        "warp": lambda a: wp.array(a, dtype=wp.float64, device="cpu", copy=False)[10:20],
    }[holder](first)
    del first
    others = [_kept_memory.empty(COUNT, np.float64) for _ in range(3)]
    assert len({place, *map(address, others)}) == 4
    for other in others:
        other.fill(1.0)
    values = held.numpy() if holder == "warp" else np.asarray(held)
    np.testing.assert_array_equal(values.view(np.float64) if holder == "view" else values, 7.0)


def test_arrays_of_kernels_hold_it():
    array = HostArray(_kept_memory.empty(COUNT, np.float32)).warp
    place = array.ptr
    assert address(_kept_memory.empty(COUNT, np.float32)) != place
    del array
    assert address(_kept_memory.empty(COUNT, np.float32)) == place


def test_no_more_is_kept_than_said():
    for _ in range(3):
        held = [_kept_memory.empty(_kept_memory.KEPT_BYTES // 5, np.uint8) for _ in range(9)]
        assert len({address(array) for array in held}) == 9
        assert sum(map(len, _kept_memory._kept)) <= _kept_memory.KEPT_BYTES
    for count in (1, 1000, _kept_memory.KEPT_BYTES + 1):
        before = len(_kept_memory._kept)
        assert _kept_memory.empty(count, np.uint8).shape == (count,)
        assert len(_kept_memory._kept) == before


def test_a_small_result_does_not_hold_a_large_buffer():
    large = _kept_memory.empty(8 * COUNT, np.float64)
    place = address(large)
    del large
    assert address(_kept_memory.empty(COUNT, np.float64)) != place


def test_threads_never_get_the_same_memory():
    wrong = []

    def use(value):
        for _ in range(200):
            array = _kept_memory.empty(COUNT, np.int32)
            array[:: COUNT // 64] = value
            if np.any(array[:: COUNT // 64] != value):
                wrong.append(value)

    threads = [threading.Thread(target=use, args=(k,)) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
