"""Gives idle memory back: what geokit keeps so that the next call need not allocate."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from typing import Any

from geokit.core import download
from geokit.core.memory import host_pool, pinned


def release_memory() -> int:
    """Give the memory that geokit keeps for later calls back to the system: like ``torch.cuda.empty_cache``.

    These are pools for results and transfers on the host (at most 128 MiB and 256 MiB), pinned pages of small GPU
    queries, and the part of a GPU's memory that warp's allocator holds although no array uses it (up to a quarter of
    the GPU; other arrays of warp in this process share it). With glibc it also gives back what lies free within the
    heap of this process. Meshes, volumes, trees and results stay. The call waits for the GPUs. Nothing needs it for
    correctness; call it before a library with an allocator of its own needs the memory.

    Returns:
        Bytes of host memory that the pools gave back.
    Example:
        >>> gk.release_memory() >= 0
        True
    """
    freed = host_pool.release() + download.release() + pinned.release()
    trim_heap()
    wp: Any = sys.modules.get("warp")
    if wp is None or not wp.is_cuda_available():
        return freed
    for device in wp.get_cuda_devices():
        if wp.is_mempool_enabled(device):
            kept = wp.get_mempool_release_threshold(device)
            # The allocator gives memory above its threshold back when it next waits for the device.
            wp.set_mempool_release_threshold(device, 0)
            try:
                wp.synchronize_device(device)
            finally:
                wp.set_mempool_release_threshold(device, kept)
    return freed


def trim_heap() -> None:
    """Give back free pages of the heap: with a large free piece it serves even an array of 64 MiB, whose pages stay."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # not glibc; Windows has no library of all symbols
        ctypes.CDLL(None).malloc_trim(0)
