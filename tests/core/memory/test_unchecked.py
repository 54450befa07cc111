"""Where warp gets no memory on a GPU, its sort and its trees are refused, not gone on with."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit.core.launches import warp_private
from geokit.core.memory import needs, unchecked
from geokit.core.memory.unchecked import allocating, sort_pairs
from tests.support.devices import DEVICES

GPU = SimpleNamespace(is_cuda=True)


class Noted:
    """Errors that warp has noted, and allocations that were tried."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.error, self.tried, self.is_full = "", [], False
        monkeypatch.setattr(unchecked, "last_noted_error", lambda: self.error)
        monkeypatch.setattr(wp, "empty", self._empty)

    def _empty(self, shape: tuple[int, ...], *, dtype: object, **_: object) -> None:
        assert dtype == wp.uint8
        assert max(shape) < 1 << 31, "more than warp numbers"
        self.tried.append(math.prod(shape))
        if self.is_full:
            raise RuntimeError(f"Failed to allocate {self.tried[-1]} bytes")


@pytest.fixture
def noted(monkeypatch: pytest.MonkeyPatch) -> Noted:
    return Noted(monkeypatch)


def test_an_error_in_the_call_is_raised(noted: Noted) -> None:
    with pytest.raises(RuntimeError, match="Failed to allocate") as caught, allocating(GPU, 100):
        noted.error = "Warp sort error"
    assert needs.is_out_of_memory(caught.value)
    assert not noted.tried


def test_after_an_earlier_error_the_memory_is_asked_for(noted: Noted) -> None:
    noted.error = "of another call"
    with allocating(GPU, 100):
        pass
    assert len(noted.tried) == 1
    assert noted.tried[0] > 100
    noted.is_full = True
    with pytest.raises(RuntimeError, match="Failed to allocate"), allocating(GPU, 100):
        pytest.fail("the call was made")


def test_where_a_call_does_damage_the_memory_is_always_asked_for(noted: Noted) -> None:
    noted.is_full = True
    with pytest.raises(RuntimeError, match="Failed to allocate"), allocating(GPU, 100, fatal=True):
        pytest.fail("the call was made")


@pytest.mark.parametrize("size", [1, 1 << 20, (1 << 31) - 1, 400 * 98_000_000, 1 << 38])
def test_any_size_can_be_asked_for(noted: Noted, size: int) -> None:
    """400 bytes a triangle are more than 2^31 from 5.4 million triangles on."""
    with allocating(GPU, size, fatal=True):
        pass
    assert size < noted.tried[0] <= size + 2 * unchecked.ROUNDING


def test_an_error_of_the_call_itself_stays(noted: Noted) -> None:
    def call() -> None:
        with allocating(GPU, 100):
            noted.error = "Warp sort error"
            raise ValueError("mine")

    with pytest.raises(ValueError, match="mine"):
        call()


def test_nothing_is_done_on_a_cpu(noted: Noted) -> None:
    noted.error, noted.is_full = "of a GPU", True
    with allocating(wp.get_device("cpu"), 1 << 60, fatal=True):
        pass
    assert not noted.tried


def test_warp_tells_its_errors() -> None:
    assert callable(wp._src.context.runtime.get_error_string)
    assert isinstance(warp_private.last_noted_error(), str)


@pytest.mark.parametrize("device", DEVICES)
def test_pairs_are_sorted(device: str) -> None:
    given = np.random.default_rng(0).permutation(1000).astype(np.int32)
    keys = wp.array(np.concatenate([given, given]), dtype=wp.int32, device=device)
    values = wp.array(np.tile(np.arange(1000, dtype=np.int32), 2), dtype=wp.int32, device=device)
    sort_pairs(keys, values, 1000)
    assert np.array_equal(keys.numpy()[:1000], np.arange(1000))
    assert np.array_equal(given[values.numpy()[:1000]], np.arange(1000))


def _is_free() -> bool:
    """Whether another thread could begin such a call now."""

    def taken() -> bool:
        got = unchecked._one_at_a_time.acquire(blocking=False)
        if got:
            unchecked._one_at_a_time.release()
        return got

    with ThreadPoolExecutor(1) as other:
        return other.submit(taken).result()


def test_one_thread_at_a_time_calls_on_gpus(noted: Noted) -> None:
    with allocating(GPU, 100):
        assert not _is_free()
        with allocating(GPU, 100):  # of the same thread, within
            pass
        assert not _is_free()
    assert _is_free()
    with allocating(SimpleNamespace(is_cuda=False), 100):
        assert _is_free()
    with pytest.raises(RuntimeError), allocating(GPU, 100):
        noted.error = "no memory"
    assert _is_free()
    noted.is_full = True
    with pytest.raises(RuntimeError), allocating(GPU, 100):
        pass
    assert _is_free()


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_threads_that_sort_at_once_get_their_own_order(device: str) -> None:
    """On a GPU warp's sorts of one stream have scratch memory in common: threads waited for each other for ever."""
    rng = np.random.default_rng(4)
    surface = gk.mesh.Surface(gk.mesh.torus(), device=device)
    points = rng.uniform(-1.5, 1.5, (6, 60_000, 3))
    expected = [surface.closest_point(part).distance for part in points]

    def asked(k: int) -> bool:
        grid = gk.points.NeighborGrid(points[k], 0.05, device=device)
        found = [surface.closest_point(points[k]).distance for _ in range(3)]
        return len(grid) == len(points[k]) and all(np.array_equal(one, expected[k]) for one in found)

    with ThreadPoolExecutor(6) as pool:
        assert all(pool.map(asked, range(6)))
