"""Layout of a chart, shared by the SVG drawing of the report and the PNG figure."""

from __future__ import annotations

import math
from typing import NamedTuple

from geokit.accuracy.report.pareto import cost_of, front_of
from geokit.accuracy.report.text import bytes_text, error_text, rate_text, seconds_text, share_text
from geokit.accuracy.trials.model import Measurement
from geokit.accuracy.trials.results import Group

# Decades of space beyond the outermost marks.
MARGIN = 0.18
# Decades between the smallest error and the line of exact answers, and between the largest error and that of infinite
# ones.
GAP = 1.0
# Decades within which a tick near the floor or the ceiling would be read as their value.
TICK_CLEARANCE = 2.0
# Position of the floor if every answer is exact and no error determines it.
LONE_FLOOR = 1e-16
# Least number of decades of an axis: noise should not look like a trend.
FEWEST_DECADES = 1.0
# An axis with more decades labels only some of them; one with fewer decades has ticks at 2 and 5 too.
MOST_LABELS, FEW_DECADES = 12, 2


class Mark(NamedTuple):
    """One setting.

    Attributes:
        row: Its measurement.
        x: Time per answer, or per call if calls are compared [s].
        y: The charted quantity; on the floor or the ceiling if it has no position on a logarithmic axis.
        method: Number of its method in the chart's list.
        device: Number of its device.
        hollow: Whether it gave wrong answers while the chart shows errors.
        letter: Its letter in the list of the front, "" if it is not on the front.
    """

    row: Measurement
    x: float
    y: float
    method: int
    device: int
    hollow: bool
    letter: str


class Plot(NamedTuple):
    """A chart, ready to be drawn.

    Attributes:
        marks: The settings that can be placed.
        methods, devices: Names by number.
        fronts: Marks of each device's front, the fastest first.
        x_range, y_range: Ends of the axes, both logarithmic.
        y_ticks: Labeled values of the vertical axis; none if there are only floor and ceiling.
        x_label, y_label: Axis labels.
        floor, floor_name: Position and meaning of zero values; None if there are none.
        ceiling: Position of infinite values; None if there are none.
        left_out: Settings whose answers are all wrong, which have no error.
    """

    marks: list[Mark]
    methods: list[str]
    devices: list[str]
    fronts: list[list[Mark]]
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    y_ticks: list[float]
    x_label: str
    y_label: str
    floor: float | None
    floor_name: str
    ceiling: float | None
    left_out: list[Measurement]


def plot_of(group: Group) -> Plot:
    """Place the marks of a group; rows without an error are listed, not drawn."""
    wrong = group.chart.vertical == "wrong"
    rows = group.rows
    values = [row.wrong_share if wrong else row.max_error for row in rows]
    usual = [value for value in values if 0.0 < value < math.inf]
    low, high = (min(usual), max(usual)) if usual else (LONE_FLOOR * 10.0**GAP, LONE_FLOOR * 10.0**GAP)
    floor = low / 10.0**GAP if 0.0 in values else None
    ceiling = high * 10.0**GAP if math.inf in values else None
    methods = list(dict.fromkeys(row.method for row in rows))
    devices = list(dict.fromkeys(row.device for row in rows))
    letters = _letters(group, devices)
    marks: list[Mark] = []
    for index, (row, value) in enumerate(zip(rows, values, strict=True)):
        if math.isnan(value):
            continue
        height = floor if value == 0.0 else ceiling if math.isinf(value) else value
        assert height is not None
        hollow = not wrong and row.wrong_share > 0.0
        place = methods.index(row.method), devices.index(row.device)
        marks.append(Mark(row, cost_of(row, group.per_call), height, *place, hollow, letters.get(index, "")))
    y_range = _axis([mark.y for mark in marks])
    return Plot(
        marks=marks,
        methods=methods,
        devices=devices,
        fronts=_fronts(marks, len(devices)),
        x_range=_axis([mark.x for mark in marks]),
        y_range=y_range,
        y_ticks=named_ticks(y_range, floor, ceiling) if usual else [],
        x_label="time of a call" if group.per_call else f"time per {_singular(group.chart.answers)}",
        y_label="share of wrong answers" if wrong else f"largest error [{group.chart.unit}]",
        floor=floor,
        floor_name="none wrong" if wrong else "exact",
        ceiling=ceiling,
        left_out=[row for row, value in zip(rows, values, strict=True) if math.isnan(value)],
    )


def _singular(noun: str) -> str:
    return noun[:-3] + "y" if noun.endswith("ies") else noun.removesuffix("s")


def named_ticks(
    ends: tuple[float, float], floor: float | None, ceiling: float | None, most: int = MOST_LABELS
) -> list[float]:
    """Ticks of a vertical axis except those at its floor and its ceiling, whose positions are not values."""
    low = 0.0 if floor is None else TICK_CLEARANCE * floor
    high = math.inf if ceiling is None else ceiling / TICK_CLEARANCE
    return [tick for tick in decade_ticks(ends, most) if low < tick < high]


def decade_ticks(ends: tuple[float, float], most: int = MOST_LABELS) -> list[float]:
    """Powers of ten within the ends of a logarithmic axis, at most ``most``; with few decades, 2 and 5 as well."""
    low, high = (math.log10(end) for end in ends)
    decades = range(math.ceil(low), math.floor(high) + 1)
    if len(decades) >= FEW_DECADES:
        step = -(-len(decades) // most)
        return [float(f"1e{exponent}") for exponent in decades if exponent % step == 0]
    exponents = range(math.floor(low), math.ceil(high) + 1)
    fine = [float(f"{digit}e{exponent}") for exponent in exponents for digit in (1, 2, 5)]
    return [value for value in fine if ends[0] <= value <= ends[1]]


def _letters(group: Group, devices: list[str]) -> dict[int, str]:
    """Letters of the rows on each device's front, in order: A, B, ... Z, AA, AB, ..."""
    named: dict[int, str] = {}
    rows = group.rows
    for device in devices:
        members = [index for index, row in enumerate(rows) if row.device == device]
        for place in front_of([rows[index] for index in members], group.chart.vertical, group.per_call):
            named[members[place]] = _letter(len(named))
    return named


def _letter(number: int) -> str:
    head, tail = divmod(number, 26)
    return (_letter(head - 1) if head else "") + chr(ord("A") + tail)


def _fronts(marks: list[Mark], device_count: int) -> list[list[Mark]]:
    members = [[mark for mark in marks if mark.letter and mark.device == device] for device in range(device_count)]
    return [sorted(front, key=lambda mark: (mark.x, -mark.y)) for front in members]


def _axis(values: list[float]) -> tuple[float, float]:
    if not values:
        return 1e-9, 1e-6
    low, high = math.log10(min(values)), math.log10(max(values))
    missing = max(0.0, FEWEST_DECADES - (high - low)) / 2.0
    return 10.0 ** (low - missing - MARGIN), 10.0 ** (high + missing + MARGIN)


def tip_of(row: Measurement, answers: str) -> str:
    """Tooltip text of a mark, in lines."""
    lines = [
        row.method,
        row.setting,
        f"{row.device}: {seconds_text(1.0 / row.rate)} each, {rate_text(row.rate)} {answers}/s",
        f"a call: {seconds_text(row.seconds)}, quartiles {share_text(row.spread)} apart",
        f"error: max {error_text(row.max_error)}, 99.9% {error_text(row.p999_error)}, "
        f"rms {error_text(row.rms_error)} [{row.unit}]",
        f"wrong: {share_text(row.wrong_share)} of {row.checked} checked",
        f"memory: prepared {bytes_text(row.byte_count)}, peak of a call {bytes_text(row.peak_bytes)}",
    ]
    return "\n".join(line for line in lines if line)
