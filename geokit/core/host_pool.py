"""Memory of the host for the lists of a CPU's searches, used again once nobody holds the last ones.

Of a radius search whose lists take 48 MB the system's clearing of pages is an eighth of the time. What a loop over
frames or time steps throws away serves its next round.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core.host_array import HostArray
from geokit.core.memory_pool import Loans

if TYPE_CHECKING:
    import warp as wp

__all__ = ["empty", "room"]

# Memory that results may hold: a few of some million numbers. What does not fit is NumPy's alone.
KEPT_BYTES = 1 << 27
# Smaller arrays come from pages that the allocator keeps by itself.
SMALLEST_BYTES = 1 << 20


def _pages(size: int) -> tuple[np.ndarray, int]:
    # NumPy asks for large pages, which are cleared in a third of the time.
    memory = np.empty(size, np.uint8)
    return memory, memory.ctypes.data


_loans = Loans(_pages, most_bytes=KEPT_BYTES, largest_bytes=KEPT_BYTES, smallest_bytes=SMALLEST_BYTES)


def empty(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array of unknown numbers, as ``numpy.empty``; a large one in memory that may have been used before."""
    lent = _loans.empty(shape, dtype)
    return np.empty(shape, dtype) if lent is None else lent[0]


def room(count: int, dtype: Any, device: "wp.Device") -> "wp.array":
    """``warp.empty`` of so many numbers; on a CPU in memory that may have been used before."""
    import warp as wp

    if device.is_cuda:
        return wp.empty(count, dtype=dtype, device=device)
    return HostArray(empty((count,), wp.dtype_to_numpy(dtype))).warp
