"""The most memory that a call takes beyond what was there before it."""

from __future__ import annotations

import contextlib
import ctypes
import gc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import warp as wp

__all__ = ["peak_bytes"]

# cuMemPoolSetAttribute's name of the high-water mark; warp can read it but not put it back.
USED_MEMORY_HIGH = 8
# What resets VmHWM, the high-water mark of the resident set (proc(5)).
RESET_PEAK = "5"


def peak_bytes(call: Callable[[], Any], device: "wp.Device") -> int:
    """Run ``call`` once and say how far memory rose above where it stood.

    On the CPU the resident set of the whole process counts: arrays of NumPy, warp and native code alike, the answer
    included, in pages that were touched. Free pages that the allocator holds are handed back first where the C library
    can; small allocations may still be served from what it keeps, so that little memory reads as none. Where the
    system does not let its high-water mark be reset, only what exceeds the process's greatest resident set so far is
    seen.

    On CUDA the device's memory pool counts, from which warp takes every array and tree; the host's memory does not.

    Args:
        call: What is measured; it should have run before, so that loaded kernels do not count.
        device: Where its memory is.
    Returns:
        Bytes, not negative.
    """
    collecting = gc.isenabled()
    # What was garbage before must not make room during the call.
    gc.disable()
    try:
        return _pool_peak(call, device) if device.is_cuda else _resident_peak(call)
    finally:
        if collecting:
            gc.enable()


def _resident_peak(call: Callable[[], Any]) -> int:
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    reset = _reset_resident()
    before = _status("VmRSS") if reset else _greatest_resident()
    answer = call()
    after = _status("VmHWM") if reset else _greatest_resident()
    del answer
    return max(0, after - before)


def _reset_resident() -> bool:
    try:
        with open("/proc/self/clear_refs", "w", encoding="ascii") as file:
            file.write(RESET_PEAK)
    except OSError:
        return False
    return True


def _status(name: str) -> int:
    """A size that /proc/self/status reports, 0 where there is none."""
    with contextlib.suppress(OSError), open("/proc/self/status", encoding="ascii", errors="replace") as file:
        for line in file:
            if line.startswith(name + ":"):
                return int(line.split()[1]) << 10
    return 0


def _greatest_resident() -> int:
    try:
        import resource
    except ImportError:  # not a POSIX system
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def _pool_peak(call: Callable[[], Any], device: "wp.Device") -> int:
    import warp as wp

    wp.synchronize_device(device)
    if not wp.is_mempool_enabled(device):
        # Without the pool: what is gone while the answer is held, a lower bound.
        free = device.free_memory
        answer = call()
        wp.synchronize_device(device)
        taken = free - device.free_memory
        del answer
        return max(0, int(taken))
    before = wp.get_mempool_used_mem_current(device)
    _reset_pool(device.ordinal)
    answer = call()
    wp.synchronize_device(device)
    high = wp.get_mempool_used_mem_high(device)
    del answer
    return max(0, int(high) - int(before))


def _reset_pool(ordinal: int) -> None:
    """Set the high-water mark of the device's default pool, which is warp's, to what is used now."""
    with contextlib.suppress(OSError, AttributeError):
        driver = ctypes.CDLL("libcuda.so.1")
        device, pool, zero = ctypes.c_int(), ctypes.c_void_p(), ctypes.c_uint64(0)
        found = driver.cuDeviceGet(ctypes.byref(device), ordinal) == 0
        if found and driver.cuDeviceGetDefaultMemPool(ctypes.byref(pool), device) == 0:
            driver.cuMemPoolSetAttribute(pool, USED_MEMORY_HIGH, ctypes.byref(zero))
