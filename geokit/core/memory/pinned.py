"""Pinned host memory, where the kernels of a small GPU query read their rows and write their results.

Creating an array on the device, or copying one to the host, takes as long as a small query. Pinned memory needs
neither.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from geokit.core.base.late_warp import wp
from geokit.core.launches import captured, prepared, warp_private
from geokit.core.memory.host_array import HostArray

# From this number of rows on, arrays on the device are faster, and sorting the queries pays.
FEWEST_ROWS = 2048
# Holds the rows and results of most queries below FEWEST_ROWS. Larger arrays get pinned memory that is not kept.
BUFFER_BYTES = 1 << 18
ALIGNMENT = 64
# Flags of a query.
MOST_FLAGS = 8

# Idle buffers, each with the device whose kernels may still write to it, or None.
_idle: list[tuple[np.ndarray, Any]] = []


class Pinned:
    """Memory for the rows and results of one query; its buffers serve other queries once it is freed.

    Args:
        device: A GPU.
    """

    __slots__ = ("_buffers", "_event", "_pending", "_used", "device")

    def __init__(self, device: "wp.Device") -> None:
        self.device = device
        self._buffers: list[np.ndarray] = []
        self._used = 0
        self._pending = False
        self._event: Any = None

    def __del__(self, idle: list[tuple[np.ndarray, Any]] = _idle) -> None:
        # A query that was interrupted has not waited for its kernels.
        busy = self.device if self._pending else None
        idle.extend((buffer, busy) for buffer in self._buffers if len(buffer) == BUFFER_BYTES)

    def take(self, shape: tuple[int, ...], dtype: Any) -> PinnedArray:
        """An uninitialized array: (N,) numbers, or (N, 3) for rows that kernels take as vectors."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if not self._buffers or self._used + size > len(self._buffers[-1]):
            self._buffers.append(_buffer() if size <= BUFFER_BYTES else _made(size))
            self._used = 0
        values = np.ndarray(shape, dtype, self._buffers[-1], self._used)
        self._used += -(-size // ALIGNMENT) * ALIGNMENT
        return PinnedArray(values, self)

    def mark_pending(self) -> None:
        """Note that a kernel may write here; reading then waits for it."""
        self._pending = True

    def close(self) -> None:
        """Declare that later launches do not write here; reading then waits only for the launches so far."""
        if self.device.is_cuda:
            self._event = self.device.stream.record_event()

    def wait(self) -> None:
        """Wait for the kernels on the device's stream; after :meth:`close`, for those launched before it."""
        if self._pending:
            _synchronize(self.device, self._event)
            self._pending = False


class PinnedArray(HostArray):
    """Rows of a :class:`Pinned`, for :func:`geokit.core.launcher.launch` on its device."""

    __slots__ = ("pinned",)

    def __init__(self, values: np.ndarray, pinned: Pinned) -> None:
        super().__init__(values)
        self.pinned = pinned

    def __getitem__(self, rows: slice) -> PinnedArray:
        return PinnedArray(self.values[rows], self.pinned)

    def numpy(self) -> np.ndarray:
        """Wait for the kernels and copy the rows."""
        self.pinned.wait()
        return self.values.copy()

    @property
    def device(self) -> "wp.Device":
        return self.pinned.device

    @property
    def descriptor(self) -> Any:
        self.pinned.mark_pending()
        return super().descriptor

    @property
    def warp(self) -> "wp.array":
        """A copy of the rows on the device."""
        self.pinned.wait()
        return super().warp.to(self.device)


class _UnreadFlags(PinnedArray):
    """Flags of launches that a graph captures: the host reads none, and does all work of which they tell the need."""

    __slots__ = ()

    def numpy(self) -> np.ndarray:
        return np.zeros_like(self.values)

    def is_raised(self, place: int) -> bool:
        return True


def host_arrays(device: "wp.Device", *shapes: tuple[tuple[int, ...], Any]) -> list[HostArray]:
    """Uninitialized arrays of NumPy shapes and types for kernel results that the host reads soon.

    ``numpy()`` of such an array waits for the kernels.
    """
    if uses_pinned_memory(device):
        pinned = Pinned(device)
        return [pinned.take(*shape) for shape in shapes]
    return [HostArray(np.empty(*shape)) for shape in shapes]


def host_flags(count: int, device: "wp.Device") -> HostArray:
    """``count`` int32 flags, initially zero, that kernels raise: a row is not finite, a query is undecided.

    Whether there is more to do is asked by :meth:`geokit.core.memory.host_array.HostArray.is_raised`.
    """
    if captured.is_captured(device):
        unread = _unread(device.alias)
        return _UnreadFlags(unread.values[:count], unread.pinned)
    (raised,) = host_arrays(device, ((count,), np.int32))
    raised.values.fill(0)
    if recording := prepared.current():
        recording.flags(raised)
    return raised


@functools.lru_cache(maxsize=16)
def _unread(device: str) -> PinnedArray:
    """Where graphs raise their flags, for as long as the process lives."""
    return Pinned(wp.get_device(device)).take((MOST_FLAGS,), np.int32)


def uses_pinned_memory(device: "wp.Device") -> bool:
    """Whether small queries on this device use pinned memory."""
    return bool(device.is_cuda) and warp_private.descriptor_type() is not None


def release() -> int:
    """Free the idle buffers and return their bytes."""
    freed = 0
    while _idle:
        buffer, busy = _idle.pop()
        if busy is not None:
            _synchronize(busy)
        freed += len(buffer)
    return freed


def _buffer() -> np.ndarray:
    try:
        buffer, busy = _idle.pop()
    except IndexError:
        return _made(BUFFER_BYTES)
    if busy is not None:
        _synchronize(busy)
    return buffer


def _made(size: int) -> np.ndarray:
    # The NumPy array keeps the warp array alive, which owns the memory.
    pinned = bool(wp.is_cuda_available())
    made: np.ndarray = wp.empty(size, dtype=wp.uint8, device="cpu", pinned=pinned).numpy()
    return made


def _synchronize(device: "wp.Device", event: Any = None) -> None:
    if event is not None:
        wp.synchronize_event(event)
    elif device.is_cuda:
        wp.synchronize_stream(device.stream)
