"""The figure of a chart: settings as marks on logarithmic axes, and each device's Pareto front as a step line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from geokit.accuracy.report.plot import Mark, Plot, decade_ticks
from geokit.accuracy.report.text import error_text, plain_text, power_text, seconds_text, share_text, tick_text
from geokit.accuracy.trials.results import Group
from geokit.render._chart import COLORS, MARKERS
from geokit.render._image import new_figure, save_figure

# Width and least height [pixels].
SIZE = (1060, 560)
# Line styles of the fronts of the first, second, ... device.
FRONT_STYLES = ("solid", "dashed", "dotted", "dashdot")
# Height of an entry of the list beside the chart; a figure that is too low for its list grows.
ROW_PIXELS = 17
# Width of that list, and the margins of the axes for titles and labels, in pixels: left, right, below, above.
LIST_PIXELS = 420
BORDERS = (78, 14, 72, 34)
# Longest entry of the list beside the chart: longer ones would squeeze the axes.
LONGEST_ENTRY = 60


def front_figure(target: Path, group: Group, plot: Plot, footer: str) -> Path:
    """Draw a group.

    Args:
        target: A .png, .svg or .pdf file.
        group: The chart and its subject.
        plot: Their layout, with at least one mark.
        footer: Small text below the chart, such as the machine.
    Returns:
        The path that was written.
    """
    wrong = group.chart.vertical == "wrong"
    # The setting last, because a narrow list cuts off the end.
    entries = [
        f"{mark.letter}  {seconds_text(mark.x)}, "
        + (share_text(mark.row.wrong_share) if wrong else error_text(mark.row.max_error))
        + f": {mark.row.setting or mark.row.method}"
        for front in plot.fronts
        for mark in front
    ]
    figure, axis = _new_axis(len({mark.method for mark in plot.marks}) + len(plot.devices) + len(entries))
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set(xlim=plot.x_range, ylim=plot.y_range, xlabel=plot.x_label, ylabel=plot.y_label)
    sides = (axis.xaxis, decade_ticks(plot.x_range), tick_text), (axis.yaxis, plot.y_ticks, power_text)
    for side, ticks, text in sides:
        # Plain text: matplotlib's own powers of ten are formulas, whose parser takes most of a figure's time.
        side.set_ticks(ticks, [text(value) for value in ticks])
        side.set_ticks([], minor=True)
    axis.grid(visible=True, which="major", color="0.9", linewidth=0.6)
    axis.set_axisbelow(True)
    for height, name in ((plot.floor, plot.floor_name), (plot.ceiling, "not finite")):
        if height is not None:
            axis.axhline(height, color="0.55", linewidth=0.8, linestyle=(0, (2, 3)), zorder=1)
            # Lines low in the chart are named at the left, high ones at the right: there are no marks there.
            low = height * height < plot.y_range[0] * plot.y_range[1]
            axis.annotate(name, (0.0 if low else 1.0, height), xycoords=("axes fraction", "data"),
                          xytext=(4 if low else -4, 3), ha="left" if low else "right",
                          textcoords="offset points", fontsize=8, color="0.35")  # fmt: skip
    for number, (device, front) in enumerate(zip(plot.devices, plot.fronts, strict=True)):
        # A step, not a slope: until there is time for the next setting, the error of this one is the best.
        axis.step([mark.x for mark in front], [mark.y for mark in front], where="post", color="0.3", linewidth=1.2,
                  zorder=2, linestyle=FRONT_STYLES[number % len(FRONT_STYLES)],
                  label=plain_text(f"front on {device}"))  # fmt: skip
        for mark in front:
            at = mark.x, mark.y
            axis.annotate(mark.letter, at, xytext=(5, 5), textcoords="offset points", fontsize=9, weight="bold")
    named: set[int] = set()
    for place in range(len(plot.devices)):
        for method, name in enumerate(plot.methods):
            marks = [mark for mark in plot.marks if (mark.method, mark.device) == (method, place)]
            if marks:
                _draw(axis, marks, "" if method in named else name)
                named.add(method)
    axis.set_title(plain_text(f"{group.chart.title}: {group.subject}"), loc="left", fontsize=11)
    _beside(figure, axis, entries)
    if footer:
        figure.text(0.01, 0.01, plain_text(footer), fontsize=7, color="0.4")
    return save_figure(figure, target)


def _new_axis(list_length: int) -> tuple[Any, Any]:
    """Create a figure without a window, high enough for its list, with axes to the left of the list."""
    width, height = SIZE[0], max(SIZE[1], ROW_PIXELS * (list_length + 2))
    figure = new_figure((width, height))
    left, right, below, above = BORDERS
    # Fixed margins: a layout engine would draw everything twice for the same result.
    across, up = (width - LIST_PIXELS - left - right) / width, (height - below - above) / height
    return figure, figure.add_axes((left / width, below / height, across, up))


def _draw(axis: Any, marks: list[Mark], name: str) -> None:
    """Marks of one method on one device; ``name`` is "" where the legend has the method already."""
    method = marks[0].method
    color = COLORS[method % len(COLORS)]
    # Color and marker repeat only after all combinations.
    marker = MARKERS[(method + method // len(COLORS)) % len(MARKERS)]
    look: dict[str, Any] = {"s": 34, "marker": marker, "linewidth": 1.1}
    look["edgecolor"] = "black" if marks[0].device else color
    for hollow, face in ((False, color), (True, "white")):
        part = [mark for mark in marks if mark.hollow == hollow]
        axis.scatter([mark.x for mark in part], [mark.y for mark in part], facecolor=face, zorder=3, **look)
    if name:
        # The legend has a mark of its own, because the first mark may be hollow.
        axis.scatter([], [], facecolor=color, label=plain_text(name), **look)


def _beside(figure: Any, axis: Any, entries: Sequence[str]) -> None:
    from matplotlib.lines import Line2D

    handles, names = axis.get_legend_handles_labels()
    blank = Line2D([], [], linestyle="none")
    cut = [entry if len(entry) <= LONGEST_ENTRY else entry[: LONGEST_ENTRY - 1] + "…" for entry in entries]
    handles += [blank] * len(cut)
    names += [plain_text(entry) for entry in cut]
    if handles:
        at = 1.0 - LIST_PIXELS / figure.bbox.width
        figure.legend(handles, names, loc="upper left", bbox_to_anchor=(at, 0.98), frameon=False, fontsize=8)
