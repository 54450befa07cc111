"""The figure of a sweep: error and share of wrong answers against the parameter, with the envelope shaded."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.report.plot import decade_ticks, named_ticks
from geokit.accuracy.report.text import plain_text, power_text
from geokit.accuracy.trials.model import Sweep
from geokit.core.files import atomic_path

SIZE = (520, 400)
# Unit of sweeps whose answers are only right or wrong.
NO_UNIT = "none"
# Number of colors in the file's palette: two lines, a shade and gray text need no more.
PALETTE = 32
ERROR_COLOR, WRONG_COLOR, ENVELOPE_COLOR = "#0072B2", "#D55E00", "#009E73"
# Decades below the smallest error or promise at which exact answers are drawn.
GAP = 1.0
LONE_FLOOR = 1e-16


def sweep_figure(path: Path, sweep: Sweep, outcomes: Sequence[Any], promised: Mapping[float, float]) -> Path:
    """Draw one sweep.

    Args:
        path: Target, a .png, .svg or .pdf file.
        sweep: The sweep.
        outcomes: What was found at its values: ``value``, ``max_error``, ``wrong_share`` and ``refusal`` of each.
        promised: The largest allowed error at each value inside the envelope.
    Returns:
        The path that was written.
    """
    from geokit.render._image import new_figure

    x, errors, wrong = (
        np.array([getattr(outcome, name) for outcome in outcomes], np.float64)
        for name in ("value", "max_error", "wrong_share")
    )
    refused = np.array([bool(outcome.refusal) for outcome in outcomes])
    covered, most = np.array(list(promised)), np.array(list(promised.values()))
    has_errors, allowed = sweep.unit != NO_UNIT, sweep.envelope.wrong_share
    figure = new_figure(SIZE)
    # Placed by hand, because a layout engine would draw everything twice for the same result.
    lower = figure.add_axes((0.15, 0.13, 0.82, 0.18 if has_errors else 0.79))
    _scale(lower, x, sweep.logarithmic)
    axes = [lower]
    if has_errors:
        upper = figure.add_axes((0.15, 0.35, 0.82, 0.57), sharex=lower)
        _draw_errors(upper, x, errors, refused, covered, most)
        upper.set_ylabel(plain_text(f"largest error [{sweep.unit}]"))
        upper.tick_params(labelbottom=False)
        axes.append(upper)
    share = np.where(refused, np.nan, wrong)
    lower.plot(x, 100.0 * share, color=WRONG_COLOR, marker="s", markersize=4, linewidth=1.2)
    if len(covered):
        # Starts below zero, so that a promise of zero is visible.
        bottom = -2.0 if has_errors else -100.0
        lower.fill_between(covered, bottom, 100.0 * allowed, color=ENVELOPE_COLOR, alpha=0.2, linewidth=0)
    if not has_errors and refused.any():
        lower.plot(x[refused], np.zeros(int(refused.sum())), linestyle="none", marker="x", color="black",
                   label="refused")  # fmt: skip
        lower.legend(frameon=False, fontsize=7.5, loc="upper left")
    lower.set(xlabel=plain_text(sweep.parameter), ylabel="wrong [%]")
    largest = float(np.nanmax(100.0 * share, initial=0.0))
    lower.set_ylim(-0.05 * max(largest, 1.0), 1.1 * max(largest, 1.0))
    axes[-1].set_title(plain_text(sweep.method), loc="left", fontsize=10)
    for axis in axes:
        axis.grid(visible=True, which="major", color="0.9", linewidth=0.6)
        axis.set_axisbelow(True)
        axis.tick_params(labelsize=8)
        axis.xaxis.label.set_fontsize(9)
        axis.yaxis.label.set_fontsize(9)
    if x[0] > x[-1]:
        lower.invert_xaxis()  # sweeps run towards failure on the right
    return _save(figure, path)


def _scale(axis: Any, x: NDArray[np.float64], logarithmic: bool) -> None:
    """A logarithmic axis with plain tick labels, if any value is positive."""
    positive = np.abs(x[x != 0.0])
    if not logarithmic or (x < 0.0).any() or len(positive) == 0:
        return
    low, high = float(positive.min()), float(positive.max())
    # Half a decade beyond the outermost values. Zero has no position on a logarithmic axis, which is linear below the
    # smallest value.
    ends = (low / 2.0, high * 2.0)
    zero = [0.0] if (x == 0.0).any() else []
    if zero:
        axis.set_xscale("symlog", linthresh=low)
        axis.set_xlim(-low / 4.0, ends[1])
    else:
        axis.set_xscale("log")
        axis.set_xlim(*ends)
    ticks = [*zero, *(tick for tick in decade_ticks(ends, SIZE[0] // 65) if not zero or tick >= low)]
    axis.set_xticks(ticks, [power_text(tick) if tick else "0" for tick in ticks])
    axis.set_xticks([], minor=True)


def _draw_errors(
    axis: Any,
    x: NDArray[np.float64],
    errors: NDArray[np.float64],
    refused: NDArray[np.bool_],
    covered: NDArray[np.float64],
    promised: NDArray[np.float64],
) -> None:
    known = ~np.isnan(errors) & ~refused
    usual = np.concatenate([errors, promised])
    usual = usual[np.isfinite(usual) & (usual > 0.0)]
    low, high = (float(usual.min()), float(usual.max())) if len(usual) else (10 * LONE_FLOOR, 10 * LONE_FLOOR)
    floor, ceiling = low / 10.0**GAP, high * 10.0**GAP
    axis.set_yscale("log")
    axis.set_ylim(floor / 2.0, ceiling * 2.0)
    ticks = named_ticks((floor / 2.0, ceiling * 2.0), floor if (errors[known] <= 0.0).any() else None, None, 8)
    ticks = ticks if len(usual) else []
    axis.set_yticks(ticks, [power_text(tick) for tick in ticks])
    axis.set_yticks([], minor=True)
    if len(covered):
        axis.fill_between(
            covered, floor / 2.0, np.maximum(promised, floor), color=ENVELOPE_COLOR, alpha=0.2, linewidth=0
        )
        axis.plot(covered, np.maximum(promised, floor), color=ENVELOPE_COLOR, linewidth=1.0, label="promise")
    drawn = np.where(errors <= 0.0, floor, np.minimum(errors, ceiling))
    axis.plot(
        x[known], drawn[known], color=ERROR_COLOR, marker="o", markersize=4.5, linewidth=1.2, label="largest error"
    )
    if (errors[known] <= 0.0).any():
        axis.axhline(floor, color="0.55", linewidth=0.8, linestyle=(0, (2, 3)), zorder=1)
        axis.annotate("exact", (1.0, floor), xycoords=("axes fraction", "data"), xytext=(-4, 3), ha="right",
                      textcoords="offset points", fontsize=7, color="0.35")  # fmt: skip
    if refused.any():
        axis.plot(x[refused], np.full(int(refused.sum()), ceiling), linestyle="none", marker="x", color="black",
                  label="refused")  # fmt: skip
    axis.legend(frameon=False, fontsize=7.5, loc="upper left")


def _save(figure: Any, path: Path) -> Path:
    """Save the figure; pixels with a palette, which takes a third of the space."""
    from PIL import Image

    from geokit.render._image import DPI, save_figure

    if path.suffix != ".png":
        return save_figure(figure, path)
    stream = io.BytesIO()
    figure.savefig(stream, dpi=DPI, format="png")
    stream.seek(0)
    with Image.open(stream) as picture, atomic_path(path) as part:
        picture.convert("RGB").quantize(PALETTE, method=Image.Quantize.MEDIANCUT).save(part, "PNG", optimize=True)
    return path
