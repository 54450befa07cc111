"""NumPy arrays in memory that goes on to other arrays once they are dropped.

To get memory anew takes as long as small kernels run: the system clears each page that it gives out, and to pin 11 MB
takes 4 ms on an H100's host, four hundred times as long as to copy them there. So the memory is kept, within a bound.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Loans", "Memory"]

ROUNDING_BYTES = 1 << 16
# Memory is lent to arrays of a quarter of its size and more.
LEAST_SHARE = 0.25


class Memory(NamedTuple):
    """What owns the bytes, where they are, and how many."""

    owner: Any
    address: int
    size: int


class Loans:
    """Memory that arrays are made in.

    Args:
        make: Gives an owner of so many new bytes, and their address.
        most_bytes: Of all arrays together, those that are in use and those whose memory waits for another.
        largest_bytes: Of one array.
        smallest_bytes: Of one array.
        ready_bytes: Memory for an array of no more than this is made when it is first asked for, as for all by default.
        patience: Memory for a larger one is made once so many times its size was asked for in vain.
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
        # An array may be dropped at any time, by any thread, and only adds to what is idle: that needs no lock.
        self._lock = threading.Lock()
        self._idle: list[Memory] = []
        self._bytes = 0

    def empty(self, shape: tuple[int, ...], dtype: Any) -> tuple[np.ndarray, Any] | None:
        """An array that holds anything, and the owner of its memory; None where there is no memory for it."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if not self._smallest <= size <= self._largest:
            return None
        with self._lock:
            memory = self._taken(size) or self._made(-(-size // ROUNDING_BYTES) * ROUNDING_BYTES)
        if memory is None:
            return None
        return np.asarray(_Loan(self._idle, memory, shape, np.dtype(dtype))), memory.owner

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
        except (MemoryError, RuntimeError):  # warp's, where there is none to pin: others do without
            return None
        self._bytes += size
        return memory


class _Loan:
    """What an array in the memory keeps alive, and gives the memory back when it goes."""

    __slots__ = ("__array_interface__", "_idle", "_memory")

    def __init__(self, idle: list[Memory], memory: Memory, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self._idle, self._memory = idle, memory
        self.__array_interface__ = {"data": (memory.address, False), "shape": shape, "typestr": dtype.str, "version": 3}

    def __del__(self) -> None:
        self._idle.append(self._memory)
