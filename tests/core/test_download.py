"""Large arrays on their way from a GPU; without one the same pieces and threads copy within the host."""

from __future__ import annotations

import functools
import threading

import numpy as np
import pytest
import warp as wp

from geokit.core import download as _download
from geokit.core.download import _Stage, download, download_into
from geokit.core.memory.memory_pool import MemoryPool
from tests.support.devices import DEVICES

KINDS = [(wp.vec3d, np.float64, (3,)), (wp.float64, np.float64, ()), (wp.int32, np.int32, ()), (wp.bool, np.bool_, ())]


def pool_on(device, most_bytes=1 << 26):
    make = functools.partial(_download._host_bytes, pinned=device != "cpu")
    return MemoryPool(make, most_bytes=most_bytes, largest_bytes=1 << 24)


def some(device, count, seed=0):
    rng = np.random.default_rng(seed)
    tables = [(rng.random((count, *row)) * 100.0).astype(kind) for _, kind, row in KINDS]
    return tables, [wp.array(table, dtype=kind[0], device=device) for table, kind in zip(tables, KINDS, strict=True)]


def through(stage, *arrays):
    results = [_download._empty_like(array) for array in arrays]
    stage.copy(arrays, results)
    return results


@pytest.fixture
def small_halves(monkeypatch):
    monkeypatch.setattr(_download, "HALF_BYTES", 1000)
    monkeypatch.setattr(_download, "LEAST_PER_THREAD", 100)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [0, 1, 41, 42, 125, 5000])
def test_pieces_make_up_the_arrays(count, device, small_halves):
    target = wp.get_device(device)
    stage = _Stage(target)
    for seed in range(2):  # what was there before must not show
        tables, arrays = some(device, count, seed)
        for found, table in zip(through(stage, *arrays), tables, strict=True):
            assert found.dtype == table.dtype
            np.testing.assert_array_equal(found, table)


@pytest.mark.parametrize("device", DEVICES)
def test_of_any_size(device):
    for count in (3, 400_000):
        tables, arrays = some(device, count)
        for found, table in zip(download(*arrays), tables, strict=True):
            np.testing.assert_array_equal(found, table)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [0, 5, 3_000_000])
def test_into_memory_that_is_there(count, device):
    bytes_ = np.random.default_rng(0).integers(0, 255, count + 32, np.uint8)
    target = np.zeros(count + 40, np.uint8)
    download_into(target[8:], wp.array(bytes_, dtype=wp.uint8, device=device))
    np.testing.assert_array_equal(target[8:], bytes_)
    assert not target[:8].any()


def test_into_memory_of_more_bytes_than_one_copy_takes(monkeypatch):
    monkeypatch.setattr(_download, "LARGEST_COPY", 1000)
    bytes_ = np.random.default_rng(0).integers(0, 255, 3456, np.uint8)
    target = np.zeros(3333, np.uint8)
    download_into(target, wp.array(bytes_, dtype=wp.uint8, device="cpu"))
    np.testing.assert_array_equal(target, bytes_[:3333])


def test_results_are_not_the_pinned_memory(small_halves):
    stage = _Stage(wp.get_device("cpu"))
    (first,) = through(stage, wp.array(np.arange(500), dtype=wp.int32, device="cpu"))
    through(stage, wp.zeros(500, dtype=wp.int32, device="cpu"))
    np.testing.assert_array_equal(first, np.arange(500))


def test_a_thread_that_fails_is_heard_and_the_stage_goes_on(small_halves, monkeypatch):
    stage = _Stage(wp.get_device("cpu"))
    array = wp.array(np.arange(2000), dtype=wp.int32, device="cpu")
    through(stage, array)
    copy = np.copyto

    def fail(target, values):
        if threading.current_thread().name.startswith("geokit"):
            raise MemoryError("no more")
        copy(target, values)

    monkeypatch.setattr(np, "copyto", fail)
    with pytest.raises(MemoryError, match="no more"):
        through(stage, array)
    monkeypatch.setattr(np, "copyto", copy)
    np.testing.assert_array_equal(through(stage, array)[0], np.arange(2000))


def test_every_byte_has_its_piece(monkeypatch):
    monkeypatch.setattr(_download, "HALF_BYTES", 10)
    halves = list(_download._pieces([0, 4, 25, 1]))
    assert halves == [[(1, 0, 4), (2, 0, 6)], [(2, 6, 10)], [(2, 16, 9), (3, 0, 1)]]
    assert list(_download._pieces([0])) == []
    assert list(_download._pieces([10])) == [[(0, 0, 10)]]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [1, 41, 5000])
def test_pooled_memory_takes_the_arrays(count, device):
    pool = pool_on(device)
    for seed in range(2):
        tables, arrays = some(device, count, seed)
        found = _download._download_pooled(tuple(arrays), pool)
        assert found is not None
        for one, table in zip(found, tables, strict=True):
            assert one.dtype == table.dtype
            assert one.flags.writeable
            np.testing.assert_array_equal(one, table)


def test_a_full_pool_takes_no_arrays():
    _, arrays = some("cpu", 4000)
    assert _download._download_pooled(tuple(arrays), pool_on("cpu", 1 << 17)) is None
    assert _download._download_pooled((wp.zeros(0, dtype=wp.vec3d, device="cpu"),), pool_on("cpu", 1 << 17)) is None


def test_memory_for_one_of_two_goes_back_untouched():
    pool = pool_on("cpu", 1 << 17)
    tables, arrays = some("cpu", 2000)
    first, second = arrays[0], arrays[1]
    for _ in range(3):
        assert _download._download_pooled((first, second, first), pool) is None
        (found,) = _download._download_pooled((first,), pool)
        np.testing.assert_array_equal(found, tables[0])


@pytest.mark.skipif(len(DEVICES) == 1, reason="needs a GPU")
def test_threads_may_download_at_once():
    wrong = []

    def work(seed):
        for _ in range(5):
            tables, arrays = some(DEVICES[1], 200_000, seed)
            same = [np.array_equal(a, b) for a, b in zip(download(*arrays), tables, strict=True)]
            wrong.extend([seed] * (not all(same)))

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
