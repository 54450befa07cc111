"""Measurement of one trial: time, memory and error."""

from __future__ import annotations

import gc
import math
import time
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.trials.peak_memory import peak_bytes
from geokit.core.interop.types import Device
from geokit.core.require import require_flag, require_instance, require_text
from geokit.errors import InputError

if TYPE_CHECKING:
    import warp as wp

    from geokit.accuracy.trials.model import Chart, Judgement, Measurement, Trial

__all__ = ["measure"]

# Fewest runs: the median of three is not affected by one disturbed run.
FEWEST_RUNS = 3
# Most runs: more do not improve the median of a fast method.
MOST_RUNS = 40
# Time for the runs of one trial [s]; slower methods take the fewest runs.
BUDGET_SECONDS = 0.6
QUICK_BUDGET_SECONDS = 0.08
# Share of the answers above the table's percentile.
PERCENTILE = 0.999


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
    from geokit.core import launcher

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
    import warp as wp

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
