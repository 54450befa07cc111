"""Scatter charts of time and error, with the Pareto front of each device."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from geokit.errors import InputError
from geokit.render._chart import COLORS, MARKERS
from geokit.render._image import new_figure, save_figure
from geokit.render.looks.checks import FLAT, checked_size, checked_target

__all__ = ["FRONT_STYLES", "MOST_LABELS", "Cloud", "decade_ticks", "pareto_chart", "plain_text", "power_text"]

# Line styles of the fronts of the first, second, ... device.
FRONT_STYLES = ("solid", "dashed", "dotted", "dashdot")
# Height of an entry of the list beside the chart; a figure that is too low for its list grows.
ROW_PIXELS = 17
# Width of that list, and the margins of the axes for titles and labels, in pixels: left, right, below, above.
LIST_PIXELS = 420
BORDERS = (78, 14, 72, 34)
# An axis with more decades labels only some of them; one with fewer decades has ticks at 2 and 5 too.
MOST_LABELS, FEW_DECADES = 12, 2
# Longest entry of the list beside the chart: longer ones would squeeze the axes.
LONGEST_ENTRY = 60


class Cloud(NamedTuple):
    """Settings of one method on one device.

    Attributes:
        name: Name in the legend; "" for none.
        style: Number of the color and marker.
        x: Horizontal coordinates, positive, shape (N,).
        y: Vertical coordinates, positive, shape (N,).
        hollow: Whether each mark is drawn as an outline; empty for none.
        ring: Whether the marks have a dark outline, as those of the second device do.
    """

    name: str
    style: int
    x: ArrayLike
    y: ArrayLike
    hollow: Sequence[bool] = ()
    ring: bool = False


def pareto_chart(
    path: str | os.PathLike[str],
    clouds: Sequence[Cloud],
    fronts: Sequence[tuple[str, ArrayLike, ArrayLike, Sequence[str]]],
    *,
    x_label: str,
    y_label: str,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    y_ticks: Sequence[float] | None = None,
    lines: Sequence[tuple[float, str]] = (),
    entries: Sequence[str] = (),
    title: str = "",
    footer: str = "",
    x_text: Callable[[float], str] | None = None,
    size: tuple[int, int] = (1060, 560),
) -> Path:
    """Draw settings as marks on logarithmic axes, and each Pareto front as a step line with a letter at each setting.

    Args:
        path: Target, a .png, .svg or .pdf file.
        clouds: The marks.
        fronts: Name in the legend ("" for none), x, y and letters of each line, the fastest first.
        x_label: Label of the horizontal axis, with its unit.
        y_label: Label of the vertical axis, with its unit.
        x_range: Ends of the horizontal axis.
        y_range: Ends of the vertical axis.
        y_ticks: Tick values of the vertical axis; None for powers of ten.
        lines: Height and name of horizontal lines, such as the level of exact results.
        entries: The list beside the chart, which explains the letters.
        title: Text above the chart.
        footer: Small text below the chart, such as the machine.
        x_text: Formats a tick of the horizontal axis; None writes a power of ten.
        size: Width and minimum height of the figure in pixels.
    Returns:
        The path that was written.
    Raises:
        InputError: Different lengths of x and y, numbers that are not finite and positive, a wrong size or file name.
        FileAccessError: The target cannot be written.
    """
    target = checked_target(path, FLAT)
    names = sum(bool(name) for name in (*(cloud.name for cloud in clouds), *(front[0] for front in fronts)))
    figure, axis = _new_axis(checked_size(size), names + len(entries))
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set(xlim=x_range, ylim=y_range, xlabel=x_label, ylabel=y_label)
    x_ticks, y_ticks = decade_ticks(x_range), decade_ticks(y_range) if y_ticks is None else y_ticks
    for side, ticks, text in ((axis.xaxis, x_ticks, x_text or power_text), (axis.yaxis, y_ticks, power_text)):
        # Plain text: matplotlib's own powers of ten are formulas, whose parser takes most of a figure's time.
        side.set_ticks(ticks, [text(value) for value in ticks])
        side.set_ticks([], minor=True)
    axis.grid(visible=True, which="major", color="0.9", linewidth=0.6)
    axis.set_axisbelow(True)
    for height, name in lines:
        axis.axhline(height, color="0.55", linewidth=0.8, linestyle=(0, (2, 3)), zorder=1)
        # Lines low in the chart are named at the left, high ones at the right: there are no marks there.
        low = height * height < y_range[0] * y_range[1]
        axis.annotate(name, (0.0 if low else 1.0, height), xycoords=("axes fraction", "data"),
                      xytext=(4 if low else -4, 3), ha="left" if low else "right",
                      textcoords="offset points", fontsize=8, color="0.35")  # fmt: skip
    for number, (name, x, y, letters) in enumerate(fronts):
        xs, ys = _numbers(name or f"front {number}", x, y)
        # A step, not a slope: until there is time for the next setting, the error of this one is the best.
        axis.step(xs, ys, where="post", color="0.3", linewidth=1.2, zorder=2,
                  linestyle=FRONT_STYLES[number % len(FRONT_STYLES)], label=plain_text(name) or None)  # fmt: skip
        for letter, at_x, at_y in zip(letters, xs, ys, strict=True):
            axis.annotate(letter, (at_x, at_y), xytext=(5, 5), textcoords="offset points", fontsize=9, weight="bold")
    for cloud in clouds:
        _draw(axis, cloud)
    axis.set_title(plain_text(title), loc="left", fontsize=11)
    _beside(figure, axis, entries)
    if footer:
        figure.text(0.01, 0.01, plain_text(footer), fontsize=7, color="0.4")
    return save_figure(figure, target)


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


def power_text(value: float) -> str:
    """Format a number briefly: "1e-7", "2e-4", "0.01", "1"."""
    text = f"{value:g}" if 1e-3 <= value < 1e4 else f"{value:.0e}"
    return text.replace("e-0", "e-").replace("e+0", "e").replace("e+", "e")


def _new_axis(size: tuple[int, int], list_length: int) -> tuple[Any, Any]:
    """Create a figure without a window, high enough for its list, with axes to the left of the list."""
    width, height = size[0], max(size[1], ROW_PIXELS * (list_length + 2))
    figure = new_figure((width, height))
    left, right, below, above = BORDERS
    # Fixed margins: a layout engine would draw everything twice for the same result.
    across, up = (width - LIST_PIXELS - left - right) / width, (height - below - above) / height
    return figure, figure.add_axes((left / width, below / height, across, up))


def _draw(axis: Any, cloud: Cloud) -> None:
    x, y = _numbers(cloud.name, cloud.x, cloud.y)
    hollow = np.asarray(cloud.hollow or np.zeros(len(x)), dtype=bool)
    color, marker = style_of(cloud.style)
    edge = "black" if cloud.ring else color
    for part, face in ((~hollow, color), (hollow, "white")):
        axis.scatter(x[part], y[part], s=34, marker=marker, facecolor=face, edgecolor=edge, linewidth=1.1, zorder=3)
    if cloud.name:
        # The legend has a mark of its own, because the first mark may be hollow.
        axis.scatter([], [], s=34, marker=marker, facecolor=color, edgecolor=edge, linewidth=1.1,
                     label=plain_text(cloud.name))  # fmt: skip


def style_of(number: int) -> tuple[str, str]:
    """Color and marker of a method; they repeat only after all combinations."""
    count = len(COLORS)
    return COLORS[number % count], MARKERS[(number + number // count) % len(MARKERS)]


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


def plain_text(text: str) -> str:
    """Escape text so that matplotlib does not parse it as a formula."""
    return text.replace("$", r"\$")


def _numbers(name: str, x: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    xs, ys = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if xs.ndim != 1 or xs.shape != ys.shape:
        raise InputError(f"{name!r}: x has shape {xs.shape}, y {ys.shape}; give equally many numbers")
    if not (np.isfinite(xs) & np.isfinite(ys) & (xs > 0) & (ys > 0)).all():
        raise InputError(f"{name!r}: holds numbers that are not finite and positive; leave those points out")
    return xs, ys
