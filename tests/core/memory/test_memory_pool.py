"""The memory pool reuses the memory of freed arrays, never that of live ones, and stays within its bound."""

from __future__ import annotations

import gc
import pickle
import threading

import numpy as np
import pytest

from geokit.core.memory.memory_pool import MemoryPool


def place(array):
    return array.__array_interface__["data"][0]


def empty(pool, count, dtype=np.uint8):
    pooled = pool.empty((count,), dtype)
    return None if pooled is None else pooled[0]


def heap(size):
    memory = np.empty(size, np.uint8)
    return memory, memory.ctypes.data


@pytest.fixture
def pool():
    return MemoryPool(heap, most_bytes=1 << 26, largest_bytes=1 << 24)


@pytest.mark.parametrize(("shape", "dtype"), [((5, 3), np.float64), ((7,), np.int32), ((3,), np.bool_)])
def test_arrays_are_like_any_other(shape, dtype, pool):
    array, memory = pool.empty(shape, dtype)
    assert array.shape == shape
    assert array.dtype == dtype
    assert array.flags.writeable
    assert array.flags.c_contiguous
    assert place(array) == memory.ctypes.data
    array[:] = 1
    assert (pickle.loads(pickle.dumps(array)) == array).all()


@pytest.mark.slow
def test_memory_is_reused_once_the_last_view_is_freed(pool):
    array = empty(pool, 70_000)
    first, view = place(array), array[10:20].reshape(2, 5)
    del array
    gc.collect()
    assert place(empty(pool, 70_000)) != first
    view[:] = 3
    del view
    gc.collect()
    assert first in [place(a) for a in (empty(pool, 70_000), empty(pool, 70_000))]


def test_arrays_that_live_do_not_overlap(pool):
    arrays = [empty(pool, 1000 + 10_000 * k) for k in range(8)]
    for number, array in enumerate(arrays):
        array[:] = number
    for number, array in enumerate(arrays):
        assert (array == number).all()


@pytest.mark.slow
def test_small_arrays_do_not_take_large_memory(pool):
    large = empty(pool, 1 << 20)
    first = place(large)
    del large
    gc.collect()
    small = empty(pool, 1000)
    assert place(small) != first
    assert place(empty(pool, (1 << 20) - 5)) == first


@pytest.mark.slow
def test_there_is_a_bound():
    pool = MemoryPool(heap, most_bytes=1 << 20, largest_bytes=1 << 19, smallest_bytes=1 << 10)
    assert empty(pool, (1 << 10) - 1) is None
    assert empty(pool, (1 << 19) + 1) is None
    assert empty(pool, 0) is None
    kept = [empty(pool, 1 << 19) for _ in range(3)]
    assert [array is None for array in kept] == [False, False, True]
    del kept
    gc.collect()
    # Idle memory of another size is freed to stay within the bound.
    small = [empty(pool, 1 << 16) for _ in range(16)]
    assert all(array is not None for array in small)
    assert empty(pool, 1 << 16) is None
    assert pool._bytes == 1 << 20


def test_large_memory_is_allocated_after_enough_refusals():
    pool = MemoryPool(heap, most_bytes=1 << 26, largest_bytes=1 << 24, ready_bytes=1 << 20, patience=3)
    assert empty(pool, 1 << 20) is not None
    large = 1 << 22
    assert [empty(pool, large) is None for _ in range(5)] == [True, True, True, False, False]
    # Memory of another size needs refusals of its own; requests of any size count.
    larger = 1 << 23
    assert [empty(pool, larger) is None for _ in range(5)] == [True, True, True, False, False]
    kept = [empty(pool, large) for _ in range(3)]  # both also serve arrays of half their size
    assert [array is None for array in kept] == [False, False, True]


def test_a_failed_allocation_serves_nothing():
    asked = []

    def refuse(size):
        asked.append(size)
        raise RuntimeError("Failed to allocate")

    pool = MemoryPool(refuse, most_bytes=1 << 20, largest_bytes=1 << 20)
    for _ in range(3):  # and it does not count towards the bound
        assert empty(pool, 1 << 20) is None
    assert asked == 3 * [1 << 20]


def test_threads_never_get_the_same_memory(pool):
    wrong = []

    def work(seed):
        rng = np.random.default_rng(seed)
        for _ in range(300):
            array = empty(pool, int(rng.integers(1, 200_000)))
            if array is None:
                continue
            array[:] = seed
            if not (array == seed).all():
                wrong.append(seed)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(1, 5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
