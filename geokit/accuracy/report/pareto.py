"""Pareto front: settings that no other setting beats in both speed and accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.accuracy.trials.model import Measurement
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.require import read_array
from geokit.errors import InputError

# Decades below the smallest error at which exact answers are placed for distances on a logarithmic axis.
EXACT_DECADES = 1.0
# The largest error of the checked answers is only this precise as an estimate for all: that of another sample differs
# by more.
ERROR_RESOLUTION = 0.01

# Parameters that say what is asked, not how it is answered.
QUESTIONS = ("max_distance", "k")


def front(seconds: ArrayLike, errors: ArrayLike, *, resolution: float = 0.0) -> NDArray[np.int64]:
    """Rows on the Pareto front: no other row is at least as fast and as accurate, and better in one of the two.

    Numbers are compared exactly, without rounding. Among rows that are equal in both, only the first is returned.

    Args:
        seconds: Times, shape (N,).
        errors: Errors, shape (N,); a row whose error is NaN is beaten by all.
        resolution: Share by which an error must be smaller than that of the next faster row on the front; with 0 any
            amount suffices.
    Returns:
        Row numbers, the fastest first; errors decrease along them.
    Raises:
        InputError: The arrays do not have the same length.
    Example:
        >>> front([1.0, 2.0, 3.0], [1e-1, 1e-3, 1e-2]).tolist()
        [0, 1]
    """
    times, values = _read(seconds, errors)
    resolution = require_finite_scalar(resolution, "resolution")
    if not 0.0 <= resolution < 1.0:
        raise InputError(f"resolution: {resolution:g} is not a share; give 0 or more, and less than 1")
    known = np.flatnonzero(~np.isnan(values) & ~np.isnan(times))
    # The sort is stable: among equal rows the first comes first.
    order = known[np.lexsort((values[known], times[known]))]
    if len(order) == 0:
        return order
    kept: list[int] = []
    for row in order:
        if not kept or values[row] < values[kept[-1]] * (1.0 - resolution):
            kept.append(int(row))
    return np.array(kept, dtype=np.int64)


def _read(seconds: ArrayLike, errors: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    times, values = read_array(seconds, "seconds", np.float64), read_array(errors, "errors", np.float64)
    if times.ndim != 1 or times.shape != values.shape:
        raise InputError(f"seconds: shape {times.shape} does not go with errors {values.shape}; give (N,) each")
    return times, values


def cost_of(row: Measurement, per_call: bool) -> float:
    """The time by which a row is compared [s]: that of a call, or that of each answer."""
    return row.seconds if per_call else 1.0 / row.rate


def same_question(rows: Sequence[Measurement]) -> list[int]:
    """Rows of one chart that answer the question which most of them answer; of equally many, the first question.

    A search with another radius, or for another number of neighbors, leaves out answers that the others give: it is
    faster, and no choice in their place.
    """
    asked = [_question(row) for row in rows]
    usual = max(dict.fromkeys(asked), key=asked.count, default=())
    return [place for place, question in enumerate(asked) if question == usual]


def _question(row: Measurement) -> tuple[tuple[str, Any], ...]:
    # The nearest few within a radius are another question than the nearest few; elsewhere a radius is a resolution.
    names = (*QUESTIONS, "radius") if "k" in row.parameters else QUESTIONS
    return tuple((name, row.parameters[name]) for name in names if name in row.parameters)


def front_of(rows: Sequence[Measurement], vertical: str, per_call: bool = False) -> list[int]:
    """Rows of one chart, subject and device that are on the Pareto front.

    Only rows of the usual question take part (:func:`same_question`). If the chart shows errors, only rows without
    wrong answers qualify, since a wrong answer has no error; if every row has wrong answers, those with the smallest
    share qualify. Rows with an infinite largest error never do.

    Args:
        rows: Measurements of one chart, one subject and one device.
        vertical: What the chart shows against time: "error" or "wrong".
        per_call: Compare times of calls instead of times per answer.
    Returns:
        Row numbers, the fastest first.
    """
    places = np.array(same_question(rows), np.int64)
    rows = [rows[place] for place in places]
    seconds = np.array([cost_of(row, per_call) for row in rows])
    if vertical == "wrong":
        return places[front(seconds, [row.wrong_share for row in rows])].tolist()
    errors = np.array([row.max_error for row in rows])
    # NaN errors are excluded, however fast the setting.
    errors[~np.isfinite(errors)] = np.nan
    shares = np.where(np.isnan(errors), np.nan, [row.wrong_share for row in rows])
    if np.isnan(shares).all():
        return []
    errors[shares != np.nanmin(shares)] = np.nan
    return places[front(seconds, errors, resolution=ERROR_RESOLUTION)].tolist()


def knee(seconds: ArrayLike, errors: ArrayLike) -> int:
    """The row of a front closest to both its best time and its best error, on logarithmic axes.

    Args:
        seconds: Times along a front, shape (N,).
        errors: Errors along it, shape (N,).
    Returns:
        A row number; the first one among ties.
    Raises:
        InputError: There is no row.
    """
    times, values = _read(seconds, errors)
    if len(times) == 0:
        raise InputError("seconds: empty; give at least one, and an error for each")
    if not ((times > 0.0) & np.isfinite(times)).all():
        row = int(np.argmin((times > 0.0) & np.isfinite(times)))
        raise InputError(f"seconds: row {row} is {times[row]}; give finite times above 0")
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
    """Powers of ten that separate settings with these errors.

    They run from the first one that the smallest positive error meets to the first one that all errors meet.
    """
    values = np.asarray(errors, dtype=np.float64)
    usual = values[(values > 0.0) & np.isfinite(values)]
    if len(usual) == 0:
        return []
    first, last = (int(np.ceil(np.log10(value))) for value in (usual.min(), usual.max()))
    # float("1e-3"), not 10.0 ** -3, gives the number nearest to the printed one.
    return [float(f"1e{exponent}") for exponent in range(last, first - 1, -1)]
