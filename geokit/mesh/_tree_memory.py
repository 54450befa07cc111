"""Memory of trees on the CPU: whole cache lines, and huge pages where the system gives them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import warp as wp

__all__ = ["tree_array"]

# Bytes of a cache line: nodes and leaves are as long as three of them.
LINE = 64


def tree_array(size: int, dtype: Any) -> "wp.array":
    """Room for ``size`` items on the CPU, which starts with a cache line.

    Queries jump about in a tree: with pages of 4 KiB the processor looks for their addresses as long as for what is
    there. NumPy asks Linux for huge pages (where they are to be asked for) from 4 MiB on, warp and malloc do not.
    """
    import warp as wp

    length = size * wp.types.type_size_in_bytes(dtype)
    memory = np.empty(length + LINE, np.uint8)
    start = -memory.ctypes.data % LINE
    values = memory[start : start + length]
    array = wp.array(ptr=values.ctypes.data, dtype=dtype, shape=(size,), device="cpu", capacity=length, copy=False)
    array._geokit_source = values  # the array does not own the memory it points to
    return array
