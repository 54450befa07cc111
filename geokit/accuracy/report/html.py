"""report.html: a self-contained page."""

from __future__ import annotations

import base64
import itertools
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from geokit.accuracy.report.html_charts import legend, svg
from geokit.accuracy.report.html_style import SCRIPT, STYLE
from geokit.accuracy.report.pareto import cost_of, same_question, tolerance_steps
from geokit.accuracy.report.plot import plot_of
from geokit.accuracy.report.text import bytes_text, error_text, rate_text, seconds_text, share_text
from geokit.accuracy.trials.model import Measurement
from geokit.accuracy.trials.results import Failure, Group

__all__ = ["Picture", "failure_text", "page"]

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
        parts.append(f'<div class="wide">{svg(plot, title, group.chart.answers)}</div>{legend(plot)}')
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
