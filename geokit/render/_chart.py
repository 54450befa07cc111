"""Line charts of measured numbers."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from geokit.core.memory.needs import needs
from geokit.core.require import read_array, require_flag, require_items
from geokit.errors import InputError
from geokit.render._image import new_axes, save_figure
from geokit.render.looks.checks import FLAT, chart_bytes, checked_label, checked_size, checked_target

# Series differ in color and in marker. The colors are Okabe and Ito's set, which color-blind readers can distinguish.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")


class Series(NamedTuple):
    """One line of a chart.

    Attributes:
        name: Name in the legend.
        x: Horizontal coordinates, shape (N,).
        y: Vertical coordinates, shape (N,).
        notes: A short text beside each point; empty for none.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    notes: Sequence[str] = ()


@needs(chart_bytes, fatal=True)
def chart(
    path: str | os.PathLike[str],
    series: Sequence[Series],
    *,
    x_label: str,
    y_label: str,
    title: str = "",
    logarithmic: bool = True,
    size: tuple[int, int] = (800, 600),
) -> Path:
    """Draw series of numbers as lines with markers, by default on logarithmic axes.

    Args:
        path: Target, a .png, .svg or .pdf file.
        series: The lines to draw, at least one.
        x_label: Label of the horizontal axis, with its unit.
        y_label: Label of the vertical axis, with its unit.
        title: Text above the chart.
        logarithmic: Make both axes logarithmic; all values must then be positive.
        size: Width and height of the figure in pixels.
    Returns:
        The path that was written.
    Raises:
        InputError: No series, different lengths of x and y, numbers that are not finite or, on logarithmic axes, not
            positive, a wrong size, or another file name.
        FileAccessError: The target cannot be written.
    """
    target = checked_target(path, FLAT)
    size = checked_size(size)
    for text, name in ((x_label, "x_label"), (y_label, "y_label"), (title, "title")):
        checked_label(text, name)
    require_flag(logarithmic, "logarithmic")
    lines = require_items(series, "series", Series)
    if not lines:
        raise InputError("series: empty; give at least one")
    figure, (axis,) = new_axes(size, 1)
    for index, line in enumerate(lines):
        x, y = (read_array(values, f"series[{index}]", np.float64) for values in (line.x, line.y))
        if x.ndim != 1 or x.shape != y.shape or (line.notes and len(line.notes) != len(x)):
            raise InputError(f"series {line.name!r}: x has shape {x.shape}, y {y.shape}; give equally many numbers")
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise InputError(f"series {line.name!r}: holds numbers that are not finite; leave those points out")
        if logarithmic and not ((x > 0).all() and (y > 0).all()):
            raise InputError(f"series {line.name!r}: holds numbers that are not positive; use logarithmic=False")
        color, marker = COLORS[index % len(COLORS)], MARKERS[index % len(MARKERS)]
        axis.plot(x, y, color=color, marker=marker, label=line.name)
        for note, at_x, at_y in zip(line.notes, x, y, strict=False):
            axis.annotate(note, (at_x, at_y), xytext=(6, 6), textcoords="offset points", fontsize=8, color=color)
    if logarithmic:
        axis.set_xscale("log")
        axis.set_yscale("log")
    axis.margins(x=0.12, y=0.1)  # room for the notes
    axis.set(xlabel=x_label, ylabel=y_label, title=title)
    axis.grid(visible=True, which="both", color="0.9", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.legend(frameon=False)
    return save_figure(figure, target)
