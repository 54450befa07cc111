"""Median times of runs on a GPU, by the wall clock or by the device's clock."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import warp as wp


def wall_median(run: Callable[[], Any], runs: int, *, warm: int = 1) -> float:
    """Seconds from the call to the synchronized result, after ``warm`` untimed runs."""
    for _ in range(warm):
        run()
    seconds = []
    for _ in range(runs):
        wp.synchronize()
        start = time.perf_counter()
        run()
        wp.synchronize()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def mesh_medians(make: Callable[[Any], Any], device: Any, runs: int) -> tuple[float, float, float]:
    """Seconds until ``make(device)``'s mesh is complete on the GPU, until it is in NumPy, and of the CPU."""
    there = wall_median(lambda: make(device), runs, warm=2)
    in_numpy = wall_median(lambda: make(device).vertices, runs, warm=2)
    return there, in_numpy, wall_median(lambda: make("cpu").vertices, runs, warm=2)


def device_median(run: Callable[[], Any], runs: int) -> float:
    """Seconds by the device's clock, after two untimed runs."""
    run()
    run()
    seconds = []
    for _ in range(runs):
        with wp.ScopedTimer("", cuda_filter=wp.TIMING_ALL, print=False, synchronize=True) as timer:
            run()
        seconds.append(timer.elapsed / 1000.0)
    return statistics.median(seconds)
