"""Numbers that kernels raise for the host: a row is not finite, a query is left undecided."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit._host_array import HostArray

if TYPE_CHECKING:
    import warp as wp

__all__ = ["Flags"]

# Of one buffer; no query raises more.
MOST_FLAGS = 4

# Pinned buffers that nobody uses. They are kept for good: a kernel whose caller gave up may still write to one.
_idle: list[Any] = []
_all: list[Any] = []


class Flags(HostArray):
    """A few int32, zero until a kernel raises them; an argument of :func:`geokit._launch.launch`.

    For a GPU they lie in pinned memory of the host, which its kernels write to: reading them is waiting for the stream,
    where an array on the device would have to be made, cleared and copied.

    A flag that is raised by mistake must do no harm: a buffer may be handed on while a kernel runs whose caller was
    interrupted.
    """

    __slots__ = ("_buffer", "_device")

    def __init__(self, count: int, device: "wp.Device") -> None:
        self._device, self._buffer = device, None
        if device.is_cuda:
            try:
                self._buffer = _idle.pop()
            except IndexError:
                self._buffer = _pinned_buffer()
        values = np.zeros(count, np.int32) if self._buffer is None else self._buffer.numpy()[:count]
        values.fill(0)
        super().__init__(values)

    def __del__(self, idle: list[Any] = _idle) -> None:
        if self._buffer is not None:
            idle.append(self._buffer)

    def numpy(self) -> np.ndarray:
        """The flags, once all that was launched on the device's stream is done."""
        if self._buffer is not None:
            import warp as wp

            wp.synchronize_stream(self._device.stream)
        return self.values


def _pinned_buffer() -> Any:
    import warp as wp

    buffer = wp.zeros(MOST_FLAGS, dtype=wp.int32, device="cpu", pinned=True)
    _all.append(buffer)
    return buffer
