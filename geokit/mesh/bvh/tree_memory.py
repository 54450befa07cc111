"""Memory of trees: on a CPU whole cache lines, and huge pages where the system gives them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core.host_array import HostArray, row_of

if TYPE_CHECKING:
    import warp as wp

__all__ = ["tree_array"]

# Bytes of a cache line: nodes and leaves are as long as three of them.
LINE = 64


def tree_array(size: int, dtype: Any, device: "wp.Device") -> "wp.array":
    """``warp.empty`` of so many items; on a CPU it starts with a cache line.

    Queries jump about in a tree: with pages of 4 KiB the processor looks for their addresses as long as for what is
    there. NumPy asks Linux for huge pages (where they are to be asked for) from 4 MiB on, warp and malloc do not. Trees
    live long: memory that goes from array to array (_kept_memory) is not for them.
    """
    import warp as wp

    if device.is_cuda:
        return wp.empty(size, dtype=dtype, device=device)
    length = size * wp.types.type_size_in_bytes(dtype)
    memory = np.empty(length + LINE, np.uint8)
    start = -memory.ctypes.data % LINE
    row = row_of(dtype)
    return HostArray(memory[start : start + length].view(row.dtype).reshape(size, *row.shape[1:])).warp
