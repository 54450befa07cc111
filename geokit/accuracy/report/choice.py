"""Which setting to take for which tolerance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from geokit.accuracy.report.pareto import cost_of, tolerance_steps
from geokit.accuracy.trials.model import Measurement

__all__ = ["Choice", "choices"]


class Choice(NamedTuple):
    """A tolerance, and the fastest setting that keeps it.

    Attributes:
        device: Where.
        tolerance: Largest error, or largest share of wrong answers where the chart shows those; 0 is exact.
        row: The setting; None where none keeps it.
    """

    device: str
    tolerance: float
    row: Measurement | None


def choices(rows: Sequence[Measurement], vertical: str, per_call: bool = False) -> list[Choice]:
    """The fastest setting of a chart for each power of ten within the range of its errors, on each device.

    What keeps a tolerance has no checked error above it and no wrong answer. That is a measurement on the answers that
    were checked, not a bound for all.

    Args:
        rows: Measurements of one chart and subject.
        vertical: What the chart shows: "error" or "wrong".
        per_call: Compare times of calls instead of times per answer.
    Returns:
        Choices device by device, the widest tolerance first; those that no setting keeps are among them.
    """
    wrong = vertical == "wrong"
    values = [row.wrong_share if wrong else row.max_error for row in rows]
    steps = tolerance_steps(values)
    if 0.0 in values:
        steps.append(0.0)
    found: list[Choice] = []
    for device in dict.fromkeys(row.device for row in rows):
        members = [row for row in rows if row.device == device and (wrong or row.wrong_share == 0.0)]
        for step in steps:
            kept = [row for row in members if (row.wrong_share if wrong else row.max_error) <= step]
            best = kept[int(np.argmin([cost_of(row, per_call) for row in kept]))] if kept else None
            found.append(Choice(device, step, best))
    return found
