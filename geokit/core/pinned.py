"""Pinned memory of the host, in which the kernels of a small query on a GPU read their rows and write their results.

To make an array on the device, or to copy one from there, takes as long as a small query does; here neither is needed.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core.host_array import HostArray

if TYPE_CHECKING:
    import warp as wp

__all__ = ["FEWEST_ROWS", "Pinned", "PinnedArray", "host_arrays", "host_flags", "serves"]

# Rows from which on arrays on the device are quicker, and the order of queries pays.
FEWEST_ROWS = 2048
# Rows and results of most queries of so many rows. What is larger gets pinned memory of its own, which is not kept.
BUFFER_BYTES = 1 << 18
ALIGNMENT = 64

# Buffers that nobody uses, each with the device whose kernels may still write to it, or None. They are kept for good.
_idle: list[tuple[np.ndarray, Any]] = []


class Pinned:
    """Room for the rows and results of one query; its buffers go to another one when it is dropped.

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
        # A caller that was interrupted has not waited for its kernels.
        busy = self.device if self._pending else None
        idle.extend((buffer, busy) for buffer in self._buffers if len(buffer) == BUFFER_BYTES)

    def take(self, shape: tuple[int, ...], dtype: Any) -> PinnedArray:
        """Rows that hold anything: (N,) numbers, or (N, 3) for what kernels take as vectors."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if not self._buffers or self._used + size > len(self._buffers[-1]):
            self._buffers.append(_buffer() if size <= BUFFER_BYTES else _made(size))
            self._used = 0
        values = np.ndarray(shape, dtype, self._buffers[-1], self._used)
        self._used += -(-size // ALIGNMENT) * ALIGNMENT
        return PinnedArray(values, self)

    def given(self) -> None:
        """Kernels get to know where the rows are."""
        self._pending = True

    def close(self) -> None:
        """No kernel that is launched from now on writes here: reading waits for those that are."""
        if self.device.is_cuda:
            self._event = self.device.stream.record_event()

    def wait(self) -> None:
        """Until all that was launched on the device's stream is done, or was when this was closed."""
        if self._pending:
            _synchronize(self.device, self._event)
            self._pending = False


class PinnedArray(HostArray):
    """Rows of a :class:`Pinned`, as arguments of :func:`geokit.core.launcher.launch` on its device."""

    __slots__ = ("room",)

    def __init__(self, values: np.ndarray, room: Pinned) -> None:
        super().__init__(values)
        self.room = room

    def __getitem__(self, rows: slice) -> PinnedArray:
        return PinnedArray(self.values[rows], self.room)

    def numpy(self) -> np.ndarray:
        """A copy of the rows as kernels have left them."""
        self.room.wait()
        return self.values.copy()

    @property
    def device(self) -> "wp.Device":
        return self.room.device

    @property
    def descriptor(self) -> Any:
        self.room.given()
        return super().descriptor

    @property
    def warp(self) -> "wp.array":
        """A copy on the device."""
        self.room.wait()
        return super().warp.to(self.device)


def host_arrays(device: "wp.Device", *shapes: tuple[tuple[int, ...], Any]) -> list[HostArray]:
    """Room for what kernels tell the host, of shapes and NumPy types: ``numpy()`` waits for the kernels."""
    if serves(device):
        room = Pinned(device)
        return [room.take(*shape) for shape in shapes]
    return [HostArray(np.empty(*shape)) for shape in shapes]


def host_flags(count: int, device: "wp.Device") -> HostArray:
    """A few int32 that kernels raise for the host, zero until then: a row is not finite, a query is left undecided."""
    (raised,) = host_arrays(device, ((count,), np.int32))
    raised.values.fill(0)
    return raised


def serves(device: "wp.Device") -> bool:
    """Whether rows for kernels of this device go into pinned memory."""
    return bool(device.is_cuda)


def _buffer() -> np.ndarray:
    try:
        buffer, busy = _idle.pop()
    except IndexError:
        return _made(BUFFER_BYTES)
    if busy is not None:
        _synchronize(busy)
    return buffer


def _made(size: int) -> np.ndarray:
    import warp as wp

    # NumPy's array keeps warp's, whose memory it is.
    pinned = bool(wp.is_cuda_available())
    made: np.ndarray = wp.empty(size, dtype=wp.uint8, device="cpu", pinned=pinned).numpy()
    return made


def _synchronize(device: "wp.Device", event: Any = None) -> None:
    import warp as wp

    if event is not None:
        wp.synchronize_event(event)
    elif device.is_cuda:
        wp.synchronize_stream(device.stream)
