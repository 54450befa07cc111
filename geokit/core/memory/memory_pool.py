"""Memory pool behind NumPy arrays: when an array is freed, its memory serves the next one.

New memory costs as much time as a small kernel: the system clears every page, and pinning 11 MB takes 4 ms on an
H100's host, four hundred times as long as copying them there. So the pool keeps memory, within a bound.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from geokit.core.base.forks import renew_after_fork

# Sizes of memory are multiples of this.
ROUNDING_BYTES = 1 << 16
# An array uses idle memory only if it fills at least this share of it.
LEAST_SHARE = 0.25


class Memory(NamedTuple):
    """A piece of memory: the object that owns it, its address and its size in bytes."""

    owner: Any
    address: int
    size: int


class MemoryPool:
    """A bounded pool of memory for NumPy arrays.

    Args:
        make: Allocates a number of bytes; returns the owner of the memory and its address.
        most_bytes: Bound of the pool: memory in use and idle memory together.
        largest_bytes: Largest array that the pool serves.
        smallest_bytes: Smallest array that the pool serves.
        ready_bytes: Memory for arrays up to this size is allocated at the first request; by default for all sizes.
        patience: Memory for a larger array is allocated once requests for ``patience`` times its size were refused (the
            ski-rental rule).
    """

    def __init__(
        self,
        make: Callable[[int], tuple[Any, int]],
        *,
        most_bytes: int,
        largest_bytes: int,
        smallest_bytes: int = 1,
        ready_bytes: int | None = None,
        patience: int = 0,
    ) -> None:
        self._make, self._most = make, most_bytes
        self._smallest, self._largest = smallest_bytes, largest_bytes
        self._ready = largest_bytes if ready_bytes is None else ready_bytes
        self._patience, self._missed = patience, 0
        # An array may be freed at any time, in any thread. That only appends to the idle list, which needs no lock.
        self._after_fork()
        renew_after_fork(self)
        self._idle: list[Memory] = []
        self._bytes = 0

    def _after_fork(self) -> None:
        self._lock = threading.Lock()

    def empty(self, shape: tuple[int, ...], dtype: Any) -> tuple[np.ndarray, Any] | None:
        """An uninitialized array and the owner of its memory; None if the pool cannot serve it."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if not self._smallest <= size <= self._largest:
            return None
        with self._lock:
            memory = self._taken(size) or self._made(-(-size // ROUNDING_BYTES) * ROUNDING_BYTES)
        if memory is None:
            return None
        return np.asarray(_PooledMemory(self._idle, memory, shape, np.dtype(dtype))), memory.owner

    def release(self) -> int:
        """Free the idle memory and return its bytes."""
        freed = 0
        with self._lock:
            while self._idle:
                freed += self._idle.pop().size
            self._bytes -= freed
        return freed

    def _taken(self, size: int) -> Memory | None:
        sizes = [memory.size for memory in self._idle]
        fitting = [k for k, whole in enumerate(sizes) if LEAST_SHARE * whole <= size <= whole]
        return self._idle.pop(min(fitting, key=sizes.__getitem__)) if fitting else None

    def _made(self, size: int) -> Memory | None:
        if size > self._ready:
            if self._missed < self._patience * size:
                self._missed += size
                return None
            self._missed -= self._patience * size
        while self._idle and self._bytes + size > self._most:
            self._bytes -= self._idle.pop(0).size
        if self._bytes + size > self._most:
            return None
        try:
            memory = Memory(*self._make(size), size)
        except (MemoryError, RuntimeError):  # warp raises RuntimeError where it cannot pin; the caller does without
            return None
        self._bytes += size
        return memory


class _PooledMemory:
    """The base object of a pooled array: when the last view is freed, it returns the memory to the pool."""

    __slots__ = ("__array_interface__", "_idle", "_memory")

    def __init__(self, idle: list[Memory], memory: Memory, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self._idle, self._memory = idle, memory
        self.__array_interface__ = {"data": (memory.address, False), "shape": shape, "typestr": dtype.str, "version": 3}

    def __del__(self) -> None:
        self._idle.append(self._memory)
