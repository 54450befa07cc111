"""The fastest setting for each tolerance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from geokit.accuracy.report.pareto import cost_of, same_question, tolerance_steps
from geokit.accuracy.trials.model import Measurement

__all__ = ["Choice", "choices"]


class Choice(NamedTuple):
    """A tolerance, and the fastest setting that meets it.

    Attributes:
        device: Name of the device.
        tolerance: Largest error, or largest share of wrong answers if the chart shows those; 0 is exact.
        row: The setting; None if none meets the tolerance.
    """

    device: str
    tolerance: float
    row: Measurement | None


def choices(rows: Sequence[Measurement], vertical: str, per_call: bool = False) -> list[Choice]:
    """The fastest setting of a chart for each power of ten within the range of its errors, on each device.

    A setting meets a tolerance if no checked error exceeds it and no checked answer is wrong. This is a measurement of
    the checked answers, not a bound for all. Settings that answer another question than most are left out.

    Args:
        rows: Measurements of one chart and subject.
        vertical: What the chart shows: "error" or "wrong".
        per_call: Compare times of calls instead of times per answer.
    Returns:
        Choices by device, the largest tolerance first, including tolerances that no setting meets.
    """
    wrong = vertical == "wrong"
    values = [row.wrong_share if wrong else row.max_error for row in rows]
    steps = tolerance_steps(values)
    if 0.0 in values:
        steps.append(0.0)
    found: list[Choice] = []
    for device in dict.fromkeys(row.device for row in rows):
        there = [row for row in rows if row.device == device]
        usual = [there[place] for place in same_question(there)]
        members = [row for row in usual if wrong or row.wrong_share == 0.0]
        for step in steps:
            kept = [row for row in members if (row.wrong_share if wrong else row.max_error) <= step]
            best = kept[int(np.argmin([cost_of(row, per_call) for row in kept]))] if kept else None
            found.append(Choice(device, step, best))
    return found
