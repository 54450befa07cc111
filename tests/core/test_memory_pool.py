"""Arrays in memory that goes on to other arrays: never while somebody sees them, and not without bound."""

from __future__ import annotations

import gc
import pickle
import threading

import numpy as np
import pytest

from geokit.core.memory_pool import Loans


def place(array):
    return array.__array_interface__["data"][0]


def empty(loans, count, dtype=np.uint8):
    lent = loans.empty((count,), dtype)
    return None if lent is None else lent[0]


def heap(size):
    memory = np.empty(size, np.uint8)
    return memory, memory.ctypes.data


@pytest.fixture
def loans():
    return Loans(heap, most_bytes=1 << 26, largest_bytes=1 << 24)


@pytest.mark.parametrize(("shape", "dtype"), [((5, 3), np.float64), ((7,), np.int32), ((3,), np.bool_)])
def test_arrays_are_like_any_other(shape, dtype, loans):
    array, memory = loans.empty(shape, dtype)
    assert array.shape == shape
    assert array.dtype == dtype
    assert array.flags.writeable
    assert array.flags.c_contiguous
    assert place(array) == memory.ctypes.data
    array[:] = 1
    assert (pickle.loads(pickle.dumps(array)) == array).all()


def test_memory_goes_on_when_the_last_view_is_dropped(loans):
    array = empty(loans, 70_000)
    first, view = place(array), array[10:20].reshape(2, 5)
    del array
    gc.collect()
    assert place(empty(loans, 70_000)) != first
    view[:] = 3
    del view
    gc.collect()
    assert first in [place(a) for a in (empty(loans, 70_000), empty(loans, 70_000))]


def test_arrays_that_live_do_not_overlap(loans):
    arrays = [empty(loans, 1000 + 10_000 * k) for k in range(8)]
    for number, array in enumerate(arrays):
        array[:] = number
    for number, array in enumerate(arrays):
        assert (array == number).all()


def test_large_memory_is_not_lent_to_small_arrays(loans):
    large = empty(loans, 1 << 20)
    first = place(large)
    del large
    gc.collect()
    small = empty(loans, 1000)
    assert place(small) != first
    assert place(empty(loans, (1 << 20) - 5)) == first


def test_there_is_a_bound():
    loans = Loans(heap, most_bytes=1 << 20, largest_bytes=1 << 19, smallest_bytes=1 << 10)
    assert empty(loans, (1 << 10) - 1) is None
    assert empty(loans, (1 << 19) + 1) is None
    assert empty(loans, 0) is None
    kept = [empty(loans, 1 << 19) for _ in range(3)]
    assert [array is None for array in kept] == [False, False, True]
    del kept
    gc.collect()
    # What is idle and does not fit makes room.
    small = [empty(loans, 1 << 16) for _ in range(16)]
    assert all(array is not None for array in small)
    assert empty(loans, 1 << 16) is None
    assert loans._bytes == 1 << 20


def test_large_memory_is_made_for_who_keeps_asking():
    loans = Loans(heap, most_bytes=1 << 26, largest_bytes=1 << 24, ready_bytes=1 << 20, patience=3)
    assert empty(loans, 1 << 20) is not None
    large = 1 << 22
    assert [empty(loans, large) is None for _ in range(5)] == [True, True, True, False, False]
    # That of another size has to be paid for too, by what is asked for of any.
    larger = 1 << 23
    assert [empty(loans, larger) is None for _ in range(5)] == [True, True, True, False, False]
    kept = [empty(loans, large) for _ in range(3)]  # both go on to arrays of half the size too
    assert [array is None for array in kept] == [False, False, True]


def test_where_no_memory_can_be_had_none_is_lent():
    asked = []

    def refuse(size):
        asked.append(size)
        raise RuntimeError("Failed to allocate")

    loans = Loans(refuse, most_bytes=1 << 20, largest_bytes=1 << 20)
    for _ in range(3):  # and it does not count as lent
        assert empty(loans, 1 << 20) is None
    assert asked == 3 * [1 << 20]


def test_threads_never_get_the_same_memory(loans):
    wrong = []

    def work(seed):
        rng = np.random.default_rng(seed)
        for _ in range(300):
            array = empty(loans, int(rng.integers(1, 200_000)))
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
