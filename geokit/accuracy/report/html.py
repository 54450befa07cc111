"""report.html: a self-contained page, with charts as inline SVG; the title of a mark describes it."""

from __future__ import annotations

import base64
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from geokit.accuracy.report.html_style import SCRIPT, STYLE
from geokit.accuracy.report.pareto import cost_of, same_question, tolerance_steps
from geokit.accuracy.report.plot import Mark, Plot, decade_ticks, plot_of, tip_of
from geokit.accuracy.report.text import (
    bytes_text,
    error_text,
    power_text,
    rate_text,
    seconds_text,
    share_text,
    tick_text,
)
from geokit.accuracy.trials.model import Measurement
from geokit.accuracy.trials.results import Failure, Group
from geokit.render._chart import COLORS

_ROW_COLUMNS = (
    *("", "method", "setting", "device", "a call", "each", "rate [1/s]", "spread"),
    *("max error", "99.9%", "rms", "wrong", "checked", "prepared", "peak of a call"),
)
_NUMBERS = frozenset((*_ROW_COLUMNS[4:], "tolerance", "memory"))
INTRODUCTION = """geokit's methods over their settings, each answer compared with an independent float64 reference that
shares no code with the method. Further left is faster, further down is more exact; both axes are logarithmic. The
stepped line is the Pareto front: no other setting is both faster and more exact than one on it. Settings with wrong
answers are on it only if every setting has some. Errors are those of the checked answers, not bounds for all. Times are
medians and comparable within this report only. Where settings give different numbers of answers, as finer voxels give
more triangles, the chart shows the time of a call."""

WIDTH, HEIGHT = 760, 430
LEFT, RIGHT, TOP, BOTTOM = 98, 16, 14, 50
RADIUS = 5.5
# Outlines of the markers, in units of their radius; the first is a circle. They are in the order of matplotlib's
# markers in geokit.render, so that a method looks the same in the page and in the figure.
SHAPES: tuple[tuple[tuple[float, float], ...], ...] = (
    (),
    ((-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9)),
    ((0.0, -1.15), (1.05, 0.85), (-1.05, 0.85)),
    ((0.0, -1.25), (1.25, 0.0), (0.0, 1.25), (-1.25, 0.0)),
    ((0.0, 1.15), (1.05, -0.85), (-1.05, -0.85)),
    ((-0.35, -1.1), (0.35, -1.1), (0.35, -0.35), (1.1, -0.35), (1.1, 0.35), (0.35, 0.35), (0.35, 1.1), (-0.35, 1.1),
     (-0.35, 0.35), (-1.1, 0.35), (-1.1, -0.35), (-0.35, -0.35)),
    ((-1.1, -0.6), (-0.6, -1.1), (0.0, -0.5), (0.6, -1.1), (1.1, -0.6), (0.5, 0.0), (1.1, 0.6), (0.6, 1.1), (0.0, 0.5),
     (-0.6, 1.1), (-1.1, 0.6), (-0.5, 0.0)),
)  # fmt: skip
DASHES = ("", "7 4", "2 3", "8 3 2 3")


class Picture(NamedTuple):
    """A map of the errors.

    Attributes:
        png: Content of the PNG file.
        caption: Caption of the figure.
    """

    png: bytes
    caption: str


def page(
    groups: Sequence[Group],
    failures: Iterable[Failure],
    pictures: Mapping[str, Picture],
    machine: Mapping[str, str],
    versions: Mapping[str, str],
) -> str:
    """Render the page.

    Args:
        groups: The charted rows.
        failures: Trials that could not be measured.
        pictures: Error maps by the slugs of the groups.
        machine: Facts about the machine.
        versions: Versions of geokit and of its dependencies.
    Returns:
        HTML without references to external resources.
    """
    failed = list(failures)
    body = [
        "<h1>Accuracy against speed</h1>",
        f"<p>{INTRODUCTION}</p>",
        '<div class="wide">' + _facts({**machine, **versions}) + "</div>",
        "<nav><h3>Charts</h3><ul>" + "".join(_link(group) for group in groups) + "</ul></nav>",
        *(_section(group, pictures.get(group.slug)) for group in groups),
        _failed(failed),
        _all_rows(groups),
        '<div id="tip" role="tooltip"></div>',
        f"<script>{SCRIPT}</script>",
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta name="generator" content="geokit {escape(versions.get("geokit", ""))}">\n'
        f"<title>geokit: accuracy against speed</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in body if part)
        + "\n</body>\n</html>\n"
    )


def _facts(facts: Mapping[str, str]) -> str:
    rows = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts.items())
    return f"<dl>{rows}</dl>"


def _link(group: Group) -> str:
    return f'<li><a href="#{group.slug}">{escape(group.chart.title)}: {escape(group.subject)}</a></li>'


def _section(group: Group, picture: Picture | None) -> str:
    plot = plot_of(group)
    title = f"{group.chart.title}: {group.subject}"
    parts = [f'<section id="{group.slug}">', f"<h2>{escape(title)}</h2>"]
    if plot.marks:
        parts.append(f'<div class="wide">{svg(plot, title, group.chart.answers)}</div>{_legend(plot)}')
    parts += [
        f'<p class="failed">Every answer wrong, so no error: {escape(row.method)}, {escape(row.setting)} on '
        f"{escape(row.device)}.</p>"
        for row in plot.left_out
    ]
    fronts = [mark for front in plot.fronts for mark in front]
    if fronts:
        parts += ["<h3>On the front</h3>", _rows_table([(mark.letter, mark.row) for mark in fronts])]
    parts.append(_choice_table(group))
    if picture is not None:
        data = base64.b64encode(picture.png).decode("ascii")
        caption = escape(picture.caption)
        parts.append("<h3>Map of the errors</h3>")
        parts.append(f'<figure><img alt="{caption}" src="data:image/png;base64,{data}">')
        parts.append(f"<figcaption>{caption}</figcaption></figure>")
    return "\n".join([*parts, "</section>"])


def _choice_table(group: Group) -> str:
    found = choices(group.rows, group.chart.vertical, group.per_call)
    if not found:
        return ""
    wrong = group.chart.vertical == "wrong"
    columns = (
        "device",
        "tolerance",
        "method",
        "setting",
        "a call" if group.per_call else "each",
        "max error",
        "memory",
    )
    lines: list[list[str]] = []
    # One line for consecutive tolerances with the same setting.
    for (device, _), run in itertools.groupby(found, key=lambda choice: (choice.device, id(choice.row))):
        members = list(run)
        limits = [share_text(c.tolerance) if wrong else error_text(c.tolerance) for c in members]
        limit = limits[0] if len(limits) == 1 else f"{limits[0]} to {limits[-1]}"
        row = members[0].row
        if row is None:
            lines.append([device, limit, "none", "", "", "", ""])
        else:
            lines.append([device, limit, row.method, row.setting, seconds_text(cost_of(row, group.per_call)),
                          error_text(row.max_error), bytes_text(row.byte_count + row.peak_bytes)])  # fmt: skip
    what = "share of wrong answers" if wrong else f"tolerance [{group.chart.unit}]"
    return (
        f"<h3>Fastest setting for each {escape(what)}</h3>"
        + _table(columns, lines)
        + '<p class="quiet">The fastest setting that meets it'
        + ("" if wrong else " without a wrong answer")
        + ". Settings that answer another question than most are left out. Memory: prepared structures plus the "
        "peak of a call.</p>"
    )


def _rows_table(named: Iterable[tuple[str, Measurement]]) -> str:
    return _table(_ROW_COLUMNS, [[name, *_row_cells(row)] for name, row in named])


def _row_cells(row: Measurement) -> list[str]:
    return [
        row.method,
        row.setting,
        row.device,
        seconds_text(row.seconds),
        seconds_text(1.0 / row.rate),
        rate_text(row.rate),
        share_text(row.spread),
        error_text(row.max_error),
        error_text(row.p999_error),
        error_text(row.rms_error),
        share_text(row.wrong_share),
        f"{row.checked}",
        bytes_text(row.byte_count),
        bytes_text(row.peak_bytes),
    ]


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    kinds = [' class="number"' if column in _NUMBERS else "" for column in columns]
    head = "".join(f"<th{kind}>{escape(column)}</th>" for kind, column in zip(kinds, columns, strict=True))
    body = "\n".join(
        "<tr>" + "".join(f"<td{kind}>{escape(cell)}</td>" for kind, cell in zip(kinds, row, strict=True)) + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'


def _failed(failures: Sequence[Failure]) -> str:
    if not failures:
        return ""
    items = "".join(f"<li>{escape(failure_text(failure))}</li>" for failure in failures)
    return f'<section id="failures"><h2>Failures</h2><ul class="failed">{items}</ul></section>'


def failure_text(failure: Failure) -> str:
    """A failure as one line of text."""
    where = ", ".join(part for part in (failure.chart or "charts", failure.subject, failure.device) if part)
    what = ", ".join(part for part in (failure.method, failure.setting) if part) or "preparation"
    return f"{where}: {what}: failed: {failure.message}"


def _all_rows(groups: Sequence[Group]) -> str:
    parts = ['<section id="rows"><h2>All rows</h2>']
    for group in groups:
        letters = {id(mark.row): mark.letter for mark in plot_of(group).marks}
        parts.append(f"<h3>{escape(group.chart.title)}: {escape(group.subject)} [{escape(group.chart.unit)}]</h3>")
        parts.append(_rows_table([(letters.get(id(row), ""), row) for row in group.rows]))
    return "\n".join([*parts, "</section>"])


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


def svg(plot: Plot, title: str, answers: str) -> str:
    """The SVG drawing; ``title`` is its text alternative."""
    parts = [
        f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}" '
        'xmlns="http://www.w3.org/2000/svg">'
    ]
    parts += _axes(plot)
    # At the lower left and upper right, where a chart has no marks.
    levels = ((plot.floor, plot.floor_name, LEFT + 4, "start"), (plot.ceiling, "not finite", WIDTH - RIGHT - 4, "end"))
    for height, name, x, anchor in levels:
        if height is not None:
            y = _y(plot, height)
            parts.append(f'<line class="level" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
            parts.append(f'<text class="level" text-anchor="{anchor}" x="{x}" y="{y - 5:.1f}">{escape(name)}</text>')
    for number, front in enumerate(plot.fronts):
        if front:
            dash = DASHES[number % len(DASHES)]
            parts.append(f'<path class="front" stroke-dasharray="{dash}" d="{_steps(plot, front)}"/>')
    parts += [_mark(plot, mark, answers) for mark in plot.marks]
    parts += [
        f'<text class="letter" x="{_x(plot, mark.x) + 7:.1f}" y="{_y(plot, mark.y) - 7:.1f}">{mark.letter}</text>'
        for front in plot.fronts
        for mark in front
    ]
    return "\n".join([*parts, "</svg>"])


def _legend(plot: Plot) -> str:
    """The meaning of colors and lines, as a list."""
    items = [
        f'<li>{_swatch(number, hollow=False)}{escape(name)}</li>'
        for number, name in enumerate(plot.methods)
    ]  # fmt: skip
    for number, device in enumerate(plot.devices):
        line = f'<line class="front" x1="0" x2="30" y1="8" y2="8" stroke-dasharray="{DASHES[number % len(DASHES)]}"/>'
        ring = ", marks with a dark outline" if number else ""
        items.append(
            f'<li><svg class="swatch line" viewBox="0 0 30 16">{line}</svg>front on {escape(device)}{ring}</li>'
        )
    if any(mark.hollow for mark in plot.marks):
        items.append(f"<li>{_swatch(0, hollow=True)}hollow: some answers are wrong</li>")
    return f'<ul class="legend">{"".join(items)}</ul>'


def _x(plot: Plot, value: float) -> float:
    low, high = (math.log10(end) for end in plot.x_range)
    return LEFT + (math.log10(value) - low) / (high - low) * (WIDTH - LEFT - RIGHT)


def _y(plot: Plot, value: float) -> float:
    low, high = (math.log10(end) for end in plot.y_range)
    return HEIGHT - BOTTOM - (math.log10(value) - low) / (high - low) * (HEIGHT - TOP - BOTTOM)


def _axes(plot: Plot) -> list[str]:
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    parts: list[str] = []
    for value in decade_ticks(plot.x_range):
        x = _x(plot, value)
        parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{bottom}"/>')
        parts.append(f'<text class="tick" text-anchor="middle" x="{x:.1f}" y="{bottom + 18}">{tick_text(value)}</text>')
    for value in plot.y_ticks:
        y = _y(plot, value)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="tick" text-anchor="end" x="{LEFT - 7}" y="{y + 4:.1f}">{power_text(value)}</text>')
    parts.append(f'<path class="axis" d="M{LEFT} {TOP}V{bottom}H{right}"/>')
    middle = (TOP + bottom) / 2
    parts.append(f'<text class="label" x="{(LEFT + right) / 2}" y="{HEIGHT - 10}">{escape(plot.x_label)}</text>')
    turned = f'transform="translate(20 {middle}) rotate(-90)"'
    parts.append(f'<text class="label" {turned}>{escape(plot.y_label)}</text>')
    return parts


def _steps(plot: Plot, front: list[Mark]) -> str:
    """The front as steps, not slopes: with less time than the next setting needs, no smaller error is available."""
    points = [(_x(plot, mark.x), _y(plot, mark.y)) for mark in front]
    path = f"M{points[0][0]:.1f} {points[0][1]:.1f}"
    return path + "".join(f"H{x:.1f}V{y:.1f}" for x, y in points[1:])


def _mark(plot: Plot, mark: Mark, answers: str) -> str:
    shape = _shape(mark.method, _x(plot, mark.x), _y(plot, mark.y), ring=mark.device > 0, hollow=mark.hollow)
    return f'<g class="mark" tabindex="0"><title>{escape(tip_of(mark.row, answers))}</title>{shape}</g>'


def _shape(method: int, x: float, y: float, *, ring: bool, hollow: bool) -> str:
    color = COLORS[method % len(COLORS)]
    outline = SHAPES[(method + method // len(COLORS)) % len(SHAPES)]
    kinds = " ".join(name for name, given in (("hollow", hollow), ("ring", ring)) if given)
    look = f'class="{kinds}" fill="{color}" stroke="{color}" stroke-width="1.6"'
    if not outline:
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{RADIUS}" {look}/>'
    corners = " ".join(f"{x + RADIUS * across:.1f},{y + RADIUS * down:.1f}" for across, down in outline)
    return f'<polygon points="{corners}" {look}/>'


def _swatch(method: int, *, hollow: bool) -> str:
    return f'<svg class="swatch" viewBox="0 0 16 16">{_shape(method, 8.0, 8.0, ring=False, hollow=hollow)}</svg>'
