"""Measurement of one trial: time, error, and peak memory above the level before the call."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.system import said
from geokit.core.interop.types import Device
from geokit.core.launches.cuda_driver import cuda_driver
from geokit.core.release import trim_heap
from geokit.core.require import require_flag, require_instance, require_text
from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.accuracy.trials.model import Chart, Judgement, Measurement, Trial

# Fewest runs: the median of three is not affected by one disturbed run.
FEWEST_RUNS = 3
# Most runs: more do not improve the median of a fast method.
MOST_RUNS = 40
# Time for the runs of one trial [s]; slower methods take the fewest runs.
BUDGET_SECONDS = 0.6
QUICK_BUDGET_SECONDS = 0.08
# Share of the answers above the table's percentile.
PERCENTILE = 0.999
# cuMemPoolSetAttribute's id of the high-water mark; warp can read it but not reset it.
USED_MEMORY_HIGH = 8
# Value that resets VmHWM, the high-water mark of the resident set (proc(5)).
RESET_PEAK = "5"


def measure(
    trial: "Trial", chart: "Chart", subject: str, device: Device = None, *, quick: bool = False
) -> "Measurement":
    """Time a trial and compare its answers with the reference.

    The first call loads kernels; its answers are checked, but it is not timed. The second call measures the peak
    memory. Then calls are timed one by one, with the garbage collector off and synchronized on CUDA: at least three,
    and more while they fit into a fixed time. The reported time is the median. The spread is the interquartile range
    over the median. On a machine with other load, times are comparable within one run only.

    An error that is not finite counts as infinite: NaN is not a right answer.

    Args:
        trial: The method with its setting.
        chart: The chart of the trial.
        subject: Name of the subject.
        device: Where to compute; None for the first CUDA device, else the CPU.
        quick: Take less time.
    Returns:
        The Measurement. ``peak_bytes`` counts the resident set of the process on the CPU and the device's memory pool
        on CUDA; in both cases it is the increase during a call, including its answer. If every answer is wrong, the
        errors are NaN.
    Raises:
        InputError: ``trial.judge`` checked no answer, or returned arrays of different lengths or negative errors.
    """
    from geokit.accuracy.trials.model import Chart, Measurement, Trial

    require_instance(trial, "trial", Trial, "make one of its class")
    require_instance(chart, "chart", Chart, "make one of its class")
    require_text(subject, "subject")
    require_flag(quick, "quick")
    place = launcher.resolve_device(device)
    judgement = trial.judge(trial.run())
    errors, wrong = _checked(judgement, trial)
    peak = peak_bytes(trial.run, place)
    seconds, spread = _timed(trial, place, QUICK_BUDGET_SECONDS if quick else BUDGET_SECONDS)
    largest, rms, percentile = _norms(errors[~wrong])
    return Measurement(
        chart=chart.name,
        subject=subject,
        method=trial.method,
        setting=trial.setting,
        device=place.alias,
        seconds=seconds,
        spread=spread,
        rate=trial.count / seconds,
        peak_bytes=peak,
        byte_count=trial.byte_count,
        checked=len(errors),
        max_error=largest,
        rms_error=rms,
        p999_error=percentile,
        wrong_share=float(np.mean(wrong)),
        unit=chart.unit,
        parameters=trial.parameters,
        judgement=judgement,
    )


def _checked(judgement: "Judgement", trial: "Trial") -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    errors = np.asarray(judgement.errors, dtype=np.float64)
    wrong = np.asarray(judgement.wrong, dtype=bool)
    name = f"{trial.method} ({trial.setting})"
    if errors.ndim != 1 or wrong.shape != errors.shape:
        raise InputError(f"{name}: the judge gave errors {errors.shape} and wrong {wrong.shape}; give (M,) each")
    if len(errors) == 0:
        raise InputError(f"{name}: the judge checked no answer; give it at least one")
    if (errors[~wrong] < 0.0).any():
        row = int(np.argmax((errors < 0.0) & ~wrong))
        raise InputError(f"{name}: the judge's error {row} is negative ({errors[row]}); give absolute errors")
    return np.where(np.isfinite(errors), errors, np.inf), wrong


def _timed(trial: "Trial", device: "wp.Device", budget: float) -> tuple[float, float]:
    times: list[float] = []
    collecting = gc.isenabled()
    gc.disable()
    try:
        while len(times) < FEWEST_RUNS or (sum(times) < budget and len(times) < MOST_RUNS):
            if device.is_cuda:
                wp.synchronize_device(device)
            started = time.perf_counter()
            answer = trial.run()
            if device.is_cuda:
                wp.synchronize_device(device)
            times.append(max(time.perf_counter() - started, 1e-9))  # the resolution of the clock
            del answer
    finally:
        if collecting:
            gc.enable()
    low, median, high = np.quantile(times, (0.25, 0.5, 0.75))
    return float(median), float((high - low) / median)


def _norms(errors: NDArray[np.float64]) -> tuple[float, float, float]:
    """Largest, root mean square and 99.9th percentile; NaN if there is no error."""
    if len(errors) == 0:
        return math.nan, math.nan, math.nan
    largest = float(errors.max())
    if largest == 0.0 or math.isinf(largest):
        percentile = float(np.quantile(errors, PERCENTILE, method="higher"))
        return largest, largest, percentile
    # Relative to the largest error, so that no square over- or underflows.
    rms = largest * math.sqrt(float(np.mean((errors / largest) ** 2)))
    # A percentile that is one of the errors, not interpolated between two.
    return largest, rms, float(np.quantile(errors, PERCENTILE, method="higher"))


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
