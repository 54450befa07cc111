"""Peak memory of a call above the level before it."""

from __future__ import annotations

import contextlib
import ctypes
import gc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from geokit.core.base.system import said
from geokit.core.launches.cuda_driver import cuda_driver
from geokit.core.release import trim_heap

if TYPE_CHECKING:
    import warp as wp

__all__ = ["peak_bytes", "reset_high_water", "resident_status"]

# cuMemPoolSetAttribute's id of the high-water mark; warp can read it but not reset it.
USED_MEMORY_HIGH = 8
# Value that resets VmHWM, the high-water mark of the resident set (proc(5)).
RESET_PEAK = "5"


def peak_bytes(call: Callable[[], Any], device: "wp.Device") -> int:
    """Run ``call`` once and return by how much memory rose above its initial level.

    On the CPU the resident set of the whole process counts: arrays of NumPy, warp and native code alike, including the
    answer, in pages that were touched. Free pages held by the allocator are released first if the C library can; small
    allocations may still be served from its reserves, so that little memory reads as none. If the system does not allow
    its high-water mark to be reset, only memory beyond the process's greatest resident set so far is seen.

    On CUDA the device's memory pool counts, from which warp allocates every array and tree; host memory does not.

    Args:
        call: The measured call; it should have run before, so that loaded kernels do not count.
        device: Device whose memory is measured.
    Returns:
        Number of bytes, not negative.
    """
    collecting = gc.isenabled()
    # Existing garbage must not free memory during the call.
    gc.disable()
    try:
        return _pool_peak(call, device) if device.is_cuda else _resident_peak(call)
    finally:
        if collecting:
            gc.enable()


def _resident_peak(call: Callable[[], Any]) -> int:
    trim_heap()
    before = resident_status("VmRSS" if reset_high_water() else "VmHWM")
    answer = call()
    after = resident_status("VmHWM")
    del answer
    return max(0, after - before)


def reset_high_water() -> bool:
    """Start VmHWM of this process anew; False if the system does not allow that."""
    with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w", encoding="ascii") as file:
        file.write(RESET_PEAK)
        return True
    return False


def resident_status(name: str) -> int:
    """A size reported by /proc/self/status, 0 if there is none."""
    words = said("/proc/self/status", f"{name}:")
    return int(words[0]) << 10 if words else 0


def _pool_peak(call: Callable[[], Any], device: "wp.Device") -> int:
    import warp as wp

    wp.synchronize_device(device)
    if not wp.is_mempool_enabled(device):
        # Without the pool: memory taken while the answer is held, a lower bound.
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
    """Reset the high-water mark of the device's default pool, which is warp's, to the current use."""
    with contextlib.suppress(OSError, AttributeError):
        driver = cuda_driver()
        device, pool, zero = ctypes.c_int(), ctypes.c_void_p(), ctypes.c_uint64(0)
        found = driver.cuDeviceGet(ctypes.byref(device), ordinal) == 0
        if found and driver.cuDeviceGetDefaultMemPool(ctypes.byref(pool), device) == 0:
            driver.cuMemPoolSetAttribute(pool, USED_MEMORY_HIGH, ctypes.byref(zero))
