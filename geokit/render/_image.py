"""Figures of pixel arrays: one panel each, with a color bar for arrays of values."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.core.files import atomic_path
from geokit.core.memory.needs import needs
from geokit.core.require import read_array, require_mapping
from geokit.errors import InputError
from geokit.render.looks.checks import (
    FLAT,
    SEQUENTIAL,
    chart_bytes,
    checked_colormap,
    checked_label,
    checked_size,
    checked_target,
    require_drawable,
    value_range,
)

# Text at 10 points reads well at 100 pixels an inch.
DPI = 100


@needs(chart_bytes, fatal=True)
def image(
    path: str | os.PathLike[str],
    panels: Mapping[str, Any] | Any,
    *,
    size: tuple[int, int] = (800, 600),
    colormap: str = SEQUENTIAL,
    value_limits: tuple[float, float] | None = None,
    label: str = "",
) -> Path:
    """Draw pixel arrays side by side; the first row of an array is at the top.

    Args:
        path: Target, a .png, .svg or .pdf file.
        panels: One array, or a mapping from titles to arrays. An array holds values, shape (H, W), NaN where there is
            none, or colors in [0, 1], shape (H, W, 3).
        size: Width and height of the figure in pixels.
        colormap: A matplotlib color map for arrays of values.
        value_limits: Values at the two ends of the color map; None uses the range of each array.
        label: Text beside the color bar.
    Returns:
        The path that was written.
    Raises:
        InputError: A wrong shape, size, range or file name.
        FileAccessError: The target cannot be written.
    """
    target = checked_target(path, FLAT)
    width, height = checked_size(size)
    checked_label(label, "label")
    checked_colormap(colormap)
    value_range(np.empty(0), value_limits)
    named = require_mapping(panels, "panels") if isinstance(panels, Mapping) else {"": panels}
    if not named:
        raise InputError("panels: empty; give at least one array")
    arrays = {title: _pixels(array, title) for title, array in named.items()}
    figure, axes = new_axes((width, height), len(arrays))
    for axis, (title, array) in zip(axes, arrays.items(), strict=True):
        axis.set_axis_off()
        axis.set_title(title)
        if array.ndim == 3:
            axis.imshow(np.clip(array, 0.0, 1.0), interpolation="none")
            continue
        low, high = value_range(array, value_limits)
        drawn = axis.imshow(array, cmap=colormap, vmin=low, vmax=high, interpolation="none")
        figure.colorbar(drawn, ax=axis, label=label, shrink=0.75)
    return save_figure(figure, target)


def _pixels(array: Any, title: str) -> NDArray[np.float64]:
    pixels = read_array(array, f"panels[{title!r}]" if title else "panels", np.float64, kinds="fiub")
    if pixels.ndim not in (2, 3) or 0 in pixels.shape or (pixels.ndim == 3 and pixels.shape[2] != 3):
        raise InputError(f"panels: {title or 'the array'} has shape {pixels.shape}, not (H, W) or (H, W, 3)")
    require_drawable(pixels, f"panels[{title!r}]" if title else "panels")
    return pixels


def new_figure(size: tuple[int, int], **options: Any) -> Any:
    """Create a white figure without a window."""
    require_package("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Without pyplot there is no global state and no choice of a window system.
    figure = Figure(figsize=(size[0] / DPI, size[1] / DPI), dpi=DPI, facecolor="white", **options)
    FigureCanvasAgg(figure)
    return figure


def new_axes(size: tuple[int, int], count: int) -> tuple[Any, list[Any]]:
    """Create a figure without a window, with ``count`` axes in a row."""
    figure = new_figure(size, layout="constrained")
    axes = figure.subplots(1, count, squeeze=False)
    return figure, list(axes[0])


def save_figure(figure: Any, target: Path) -> Path:
    """Write a figure in the format of its target. One figure gives the same bytes each time: files hold no date."""
    import matplotlib

    kind = target.suffix[1:].lower()
    dates = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    with atomic_path(target) as part, matplotlib.rc_context({"svg.hashsalt": "geokit"}):
        figure.savefig(part, dpi=DPI, format=kind, metadata=dates.get(kind))
    return target
