"""Memory of the host for large results, used again once nobody holds the last ones.

The system clears each page that it hands out: of a radius search whose lists take 48 MB that is an eighth of the time.
What a loop over frames or time steps throws away serves its next round.
"""

from __future__ import annotations

import sys
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit._host_array import HostArray

if TYPE_CHECKING:
    import warp as wp

__all__ = ["KEPT_BYTES", "empty", "room"]

# Memory that may lie idle: a few results of some million numbers.
KEPT_BYTES = 1 << 27
# Smaller arrays come from pages that the allocator keeps by itself.
SMALLEST = 1 << 20
# A result may leave so much of a buffer unused.
LARGEST_SHARE = 2

# The oldest first.
_kept: list[NDArray[np.uint8]] = []
_lock = threading.Lock()


def empty(count: int, dtype: Any) -> NDArray[Any]:
    """An array (count,) of unknown numbers, as ``numpy.empty``; often a view of memory that has been used before.

    It and all its views hold the memory, as views of any NumPy array do; only when none is left is it handed on.
    """
    size = count * np.dtype(dtype).itemsize
    if not SMALLEST <= size <= KEPT_BYTES:
        return np.empty(count, dtype)
    with _lock:
        buffer = _idle(size)
        if buffer is None:
            buffer = np.empty(size, np.uint8)
            _kept.append(buffer)
            while sum(len(kept) for kept in _kept) > KEPT_BYTES:
                _kept.pop(0)  # whoever holds it goes on doing so
        return buffer[:size].view(dtype)


def room(count: int, dtype: Any, device: "wp.Device") -> "wp.array":
    """``warp.empty`` of so many numbers; on a CPU in memory that may have been used before."""
    import warp as wp

    if device.is_cuda:
        return wp.empty(count, dtype=dtype, device=device)
    return HostArray(empty(count, wp.dtype_to_numpy(dtype))).warp


def _idle(size: int) -> NDArray[np.uint8] | None:
    for place in range(len(_kept)):
        # Two who know of it: the list, and this call's argument. A view would be a third.
        if size <= len(_kept[place]) <= LARGEST_SHARE * size and sys.getrefcount(_kept[place]) <= 2:
            _kept.append(_kept.pop(place))
            return _kept[-1]
    return None
