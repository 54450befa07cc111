"""The library of NVIDIA's driver, for what warp does not offer."""

from __future__ import annotations

import ctypes
import functools


@functools.cache
def cuda_driver() -> ctypes.CDLL:
    """The driver's library, whose functions return 0 or the number of an error.

    Raises:
        OSError: This machine has no NVIDIA driver.
    """
    return ctypes.CDLL("libcuda.so.1")
