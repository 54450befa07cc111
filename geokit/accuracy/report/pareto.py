"""Settings that no other one beats in both speed and accuracy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.accuracy.trials.model import Measurement
from geokit.errors import InputError

__all__ = ["cost_of", "front", "front_of", "knee", "tolerance_steps"]

# Exact answers lie this many decades below the smallest error where distances on a logarithmic axis are compared.
EXACT_DECADES = 1.0
# The largest error of the answers that were checked says no more about all of them: another sample's differs by more.
ERROR_RESOLUTION = 0.01


def front(seconds: ArrayLike, errors: ArrayLike, *, resolution: float = 0.0) -> NDArray[np.int64]:
    """Rows that no other row beats: none is as fast and as exact, and better in one of the two.

    Exact: numbers are compared, nothing is rounded. Of rows that are equal in both, the first stands for all.

    Args:
        seconds: Times, shape (N,).
        errors: Errors, shape (N,); a row whose error is NaN is beaten by all.
        resolution: Share by which an error must be smaller than that of the faster row before it on the front; with 0,
            any amount will do.
    Returns:
        Row numbers, the fastest first; errors fall along them.
    Raises:
        InputError: The two do not have the same length.
    Example:
        >>> front([1.0, 2.0, 3.0], [1e-1, 1e-3, 1e-2]).tolist()
        [0, 1]
    """
    times, values = np.asarray(seconds, dtype=np.float64), np.asarray(errors, dtype=np.float64)
    if times.ndim != 1 or times.shape != values.shape:
        raise InputError(f"seconds: shape {times.shape} does not go with errors {values.shape}; give (N,) each")
    known = np.flatnonzero(~np.isnan(values) & ~np.isnan(times))
    # The sort is stable: of equal rows the first comes first.
    order = known[np.lexsort((values[known], times[known]))]
    if len(order) == 0:
        return order
    kept: list[int] = []
    for row in order:
        if not kept or values[row] < values[kept[-1]] * (1.0 - resolution):
            kept.append(int(row))
    return np.array(kept, dtype=np.int64)


def cost_of(row: Measurement, per_call: bool) -> float:
    """The time that counts for a row [s]: that of a call, or that of each of its answers."""
    return row.seconds if per_call else 1.0 / row.rate


def front_of(rows: Sequence[Measurement], vertical: str, per_call: bool = False) -> list[int]:
    """Rows of one chart, subject and device that are on its front.

    Where the chart shows errors, only rows without wrong answers can be on it, as a wrong answer has no error; where
    every row has some, those with the smallest share. Nor can a row whose largest error is infinite.

    Args:
        rows: Measurements of one chart, one subject and one device.
        vertical: What the chart shows against time: "error" or "wrong".
        per_call: Compare times of calls instead of times per answer.
    Returns:
        Row numbers, the fastest first.
    """
    seconds = np.array([cost_of(row, per_call) for row in rows])
    if vertical == "wrong":
        return front(seconds, [row.wrong_share for row in rows]).tolist()
    errors = np.array([row.max_error for row in rows])
    # What is not a number is no answer, however quick.
    errors[~np.isfinite(errors)] = np.nan
    shares = np.where(np.isnan(errors), np.nan, [row.wrong_share for row in rows])
    if np.isnan(shares).all():
        return []
    errors[shares != np.nanmin(shares)] = np.nan
    return front(seconds, errors, resolution=ERROR_RESOLUTION).tolist()


def knee(seconds: ArrayLike, errors: ArrayLike) -> int:
    """The row of a front that is nearest to its best time and its best error at once, on logarithmic axes.

    Args:
        seconds: Times along a front, shape (N,).
        errors: Errors along it, shape (N,).
    Returns:
        A row number; the first of several that are equally near.
    Raises:
        InputError: There is no row.
    """
    times, values = np.asarray(seconds, dtype=np.float64), np.asarray(errors, dtype=np.float64)
    if times.ndim != 1 or times.shape != values.shape or len(times) == 0:
        raise InputError(f"seconds: shape {times.shape} with errors {values.shape}; give (N,) each, N at least 1")
    distance = _share(np.log10(times)) ** 2 + _share(_decades(values)) ** 2
    return int(np.argmin(distance))


def _decades(values: NDArray[np.float64]) -> NDArray[np.float64]:
    usual = (values > 0.0) & np.isfinite(values)
    logs = np.zeros(len(values))
    logs[usual] = np.log10(values[usual])
    low, high = (logs[usual].min(), logs[usual].max()) if usual.any() else (0.0, 0.0)
    logs[values <= 0.0] = low - EXACT_DECADES
    logs[~np.isfinite(values)] = high + EXACT_DECADES
    return logs


def _share(values: NDArray[np.float64]) -> NDArray[np.float64]:
    extent = float(np.ptp(values))
    return (values - values.min()) / extent if extent > 0.0 else np.zeros(len(values))


def tolerance_steps(errors: ArrayLike) -> list[float]:
    """Powers of ten that tell settings of these errors apart: from the first that the smallest positive one keeps to
    the first that all keep.
    """
    values = np.asarray(errors, dtype=np.float64)
    usual = values[(values > 0.0) & np.isfinite(values)]
    if len(usual) == 0:
        return []
    first, last = (int(np.ceil(np.log10(value))) for value in (usual.min(), usual.max()))
    # float("1e-3"), not 10.0 ** -3: the nearest number to what is printed.
    return [float(f"1e{exponent}") for exponent in range(last, first - 1, -1)]
