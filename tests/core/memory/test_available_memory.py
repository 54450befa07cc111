"""What is free on a GPU: the driver's count, and what warp's allocator keeps for the next array."""

from __future__ import annotations

import ctypes
from types import SimpleNamespace

import pytest
import warp as wp

import geokit as gk
from geokit.core.memory import available_memory
from tests.support.devices import DEVICES


class Driver:
    """A driver whose pool holds 100 bytes, of which arrays have 30."""

    def __init__(self, status: int = 0) -> None:
        self.status = status

    def cuDeviceGet(self, *_: object) -> int:
        return 0

    def cuDeviceGetDefaultMemPool(self, *_: object) -> int:
        return 0

    def cuMemPoolGetAttribute(self, _: object, attribute: ctypes.c_int, size: object) -> int:
        size._obj.value = {5: 100, 7: 30}[attribute.value]
        return self.status


@pytest.mark.parametrize(("status", "has_pool", "expected"), [(0, True, 1070), (1, True, 1000), (0, False, 1000)])
def test_idle_memory_of_the_pool_is_free(monkeypatch, status: int, has_pool: bool, expected: int) -> None:
    monkeypatch.setattr(available_memory, "cuda_driver", lambda: Driver(status))
    device = SimpleNamespace(is_cpu=False, free_memory=1000, ordinal=0, is_mempool_enabled=has_pool)
    assert available_memory.available(device) == expected


@pytest.mark.skipif(len(DEVICES) < 2, reason="needs a GPU")
def test_what_an_array_had_is_free_again() -> None:
    device = wp.get_device("cuda:0")
    gk.release_memory()
    before, size = available_memory.available(device), 1 << 30
    array = wp.empty(size, dtype=wp.uint8, device=device)
    assert before - available_memory.available(device) == pytest.approx(size, rel=0.1)
    del array  # kept by the allocator: the driver does not count it as free
    wp.synchronize_device(device)
    assert available_memory.available(device) == pytest.approx(before, abs=size // 10)


def test_what_does_not_fit_is_refused_with_what_would(monkeypatch):
    monkeypatch.setattr(available_memory, "available_host", lambda: 1 << 20)
    available_memory.require_room(1 << 20, "it needs", "use less")
    with pytest.raises(gk.DeviceMemoryError, match=r"^it needs about 4 MiB, of 1 MiB free; use a quarter$") as refused:
        available_memory.require_room(4 << 20, "it needs", lambda times: "use a quarter" if times == 4.0 else "")
    assert refused.value.need == 4 << 20
    with pytest.raises(gk.DeviceMemoryError, match="of 1 MiB free on cpu; use less"):
        available_memory.require_room((1 << 20) + 1, "it needs", "use less", wp.get_device("cpu"))
