"""Memory of trees: on a CPU aligned to cache lines, and in huge pages where the system provides them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core.memory.host_array import HostArray, row_of

if TYPE_CHECKING:
    import warp as wp

__all__ = ["tree_array"]

# Bytes of a cache line; nodes and leaves are three lines long.
LINE = 64


def tree_array(size: int, dtype: Any, device: "wp.Device") -> "wp.array":
    """``warp.empty`` for trees; on a CPU the array is aligned to a cache line.

    Queries read a tree at random places: with pages of 4 KiB the address translation takes as long as the data. NumPy
    asks Linux for huge pages from 4 MiB on, where the system provides them on request; warp and malloc do not. The host
    pool (core/memory/host_pool.py) is not used, because trees live long.
    """
    import warp as wp

    if device.is_cuda:
        return wp.empty(size, dtype=dtype, device=device)
    length = size * wp.types.type_size_in_bytes(dtype)
    memory = np.empty(length + LINE, np.uint8)
    start = -memory.ctypes.data % LINE
    row = row_of(dtype)
    return HostArray(memory[start : start + length].view(row.dtype).reshape(size, *row.shape[1:])).warp
