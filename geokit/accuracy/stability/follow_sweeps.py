"""Runs sweeps towards failure and writes the page with the envelope that each method promises."""

from __future__ import annotations

import importlib
import math
import os
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from geokit import native
from geokit.accuracy.report.folder import FORMATS as FIGURE_FORMATS
from geokit.accuracy.report.stability_figures import NO_UNIT, sweep_figure
from geokit.accuracy.trials.model import Sweep
from geokit.accuracy.trials.running import time_left
from geokit.core import launcher
from geokit.core.files import atomic_path, is_there
from geokit.core.interop.types import Device
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import (
    require_callable,
    require_choice,
    require_flag,
    require_instance,
    require_items,
    require_path,
)
from geokit.errors import FileAccessError, GeokitError, InputError

INTRODUCTION = """\
Each sweep varies one parameter towards failure and compares the answers with an independent float64 reference that
shares no code with the method. The promise holds up to the last value of the envelope, which
`tests/accuracy/stability/test_envelopes.py` asserts; beyond it, nothing is promised. In the figures the envelope is
shaded, exact answers lie on the lowest line, and crosses mark values at which the method refuses with a named error.
The step of the granular example is swept in docs/granular.md."""
# Modules of sweeps by subject, in the order of the page.
PARTS = {
    "mesh": ("distance", "sign", "rays", "repair"),
    "volume": ("mesh", "sample", "rays", "change"),
    "points": ("sweeps",),
}
PAGE, FIGURES = "stability.md", Path("figures") / "stability"


class Outcome(NamedTuple):
    """Outcome of a sweep at one value of its parameter.

    Attributes:
        value: Value of the parameter.
        max_error: Largest error of the answers that are not wrong [unit of the sweep]; NaN if there is none.
        wrong_share: Share of the answers that are wrong.
        refusal: The method's own error if it refused to answer, else "".
    """

    value: float
    max_error: float
    wrong_share: float
    refusal: str = ""


@needs(lambda *_, **__: 4 << 20, fatal=True)  # of modules
def sweeps(device: Device = None) -> list[Sweep]:
    """All sweeps of meshes, volumes and points.

    Closest points, signed distances, signs and rays are swept by position and size of the mesh, slivers, holes, flips,
    copies, overlaps, edges, vertices and grazing angles; the other methods by the inputs that break them. Answers are
    compared with analytic shapes and float64 brute force. Each promise of meshes leaves at least a factor of four to
    the values measured on several seeds.

    Args:
        device: Where the methods compute; None for the first GPU, else the CPU.
    Returns:
        The sweeps, with unique names. Those of methods that need OpenVDB are left out if it is missing.
    Example:
        >>> sweep = gk.accuracy.sweeps("cpu")[0]
        >>> sweep.name, bool(sweep.ask(1e8).errors.max() <= sweep.envelope.error)
        ('closest_point_origin', True)
    """
    return [sweep for subject in PARTS for sweep in sweeps_of(subject, device)]


def sweeps_of(subject: str, device: Device = None) -> list[Sweep]:
    """The sweeps of "mesh", "volume" or "points"."""
    modules = [importlib.import_module(f"geokit.accuracy.stability.{subject}_{part}") for part in PARTS[subject]]
    found = [module.SWEEPS for module in modules]
    if native.available():
        found += [module.WITH_OPENVDB for module in modules if hasattr(module, "WITH_OPENVDB")]
    return [sweep for part in found for sweep in part.on(device)]


def follow(sweep: Sweep, values: Iterable[float] | None = None) -> list[Outcome]:
    """Run the method of a sweep at each value.

    A GeokitError is an outcome of its own: the method refuses to answer, which is not a wrong answer.

    Args:
        sweep: The sweep.
        values: Values of the parameter; None for those of the sweep.
    Returns:
        One outcome for each value.
    Raises:
        InputError: The sweep checked no answer.
    """
    require_instance(sweep, "sweep", Sweep, "make one of its class, or take one of sweeps()")
    chosen = sweep.values if values is None else require_items(values, "values")
    return [_asked(sweep, require_finite_scalar(value, f"values[{row}]")) for row, value in enumerate(chosen)]


def _asked(sweep: Sweep, value: float) -> Outcome:
    try:
        judgement = sweep.ask(value)
    except GeokitError as error:
        return Outcome(value, math.nan, 0.0, f"{type(error).__name__}: {' '.join(str(error).split())}")
    errors, wrong = np.asarray(judgement.errors, dtype=np.float64), np.asarray(judgement.wrong, dtype=bool)
    if len(wrong) == 0:
        raise InputError(f"sweep {sweep.name!r}: no answer was checked at {value:g}; give its judge at least one")
    right = errors[~wrong]
    # NaN is not a right answer: it counts as an infinite error.
    largest = float(np.where(np.isfinite(right), right, np.inf).max()) if len(right) else math.nan
    return Outcome(value, largest, float(wrong.mean()))


def inside(sweep: Sweep, value: float) -> bool:
    """Whether the envelope covers the value, which must not lie beyond ``last`` in the direction of the sweep."""
    last = sweep.envelope.last
    return value >= last if sweep.values[0] > sweep.values[-1] else value <= last


def promised(sweep: Sweep, value: float) -> float:
    """The largest error that the envelope allows at the value."""
    error = sweep.envelope.error
    return float(error(value)) if callable(error) else float(error)


def keeps(sweep: Sweep, outcome: Outcome) -> bool:
    """Whether the outcome keeps the promise of the envelope; a refusal does not."""
    if outcome.refusal:
        return False
    if outcome.wrong_share > sweep.envelope.wrong_share:
        return False
    # If all answers are wrong, and the promise allows it, there is no error to compare.
    return math.isnan(outcome.max_error) or outcome.max_error <= promised(sweep, outcome.value)


@needs(lambda *_, **__: 14 << 20, fatal=True)  # of the charts' library
def write_stability(
    out: str | os.PathLike[str],
    *,
    force: bool = False,
    chosen: Sequence[Sweep] | None = None,
    device: Device = None,
    progress: Callable[[str], None] | None = None,
    figure_format: str = "png",
) -> Path:
    """Run all values of the sweeps and write stability.md, with a figure for each sweep in figures/stability.

    Each file is replaced atomically, the page last. A sweep that raises anything but a GeokitError ends the run and
    leaves the earlier page unchanged.

    Args:
        out: The folder, which may hold other files; created if missing.
        force: Replace an earlier page.
        chosen: The sweeps; None for all.
        device: Where the methods of all sweeps compute; None for the first GPU, else the CPU.
        progress: Called with a line of text before each sweep; after two seconds it says how much time is left.
        figure_format: "png", "svg" or "pdf". The page links to figures in PDF, which Markdown does not show.
    Returns:
        Path of the page.
    Raises:
        InputError: The folder already holds a page and ``force`` is not given, there is no sweep, or two share a name.
        FileAccessError: The folder cannot be written.
    """
    folder = require_path(out, "out")
    if progress is not None:
        require_callable(progress, "progress")
    require_choice(figure_format, "figure_format", FIGURE_FORMATS)
    launcher.resolve_device(device)
    page = check_page(folder, force=force)
    found = sweeps(device) if chosen is None else require_items(chosen, "chosen", Sweep)
    names = [sweep.name for sweep in found]
    if not found:
        raise InputError("chosen: empty; give at least one sweep")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"chosen: two sweeps are called {twice!r}; give each a name of its own")
    try:
        (folder / FIGURES).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileAccessError(f"{folder}: cannot be made a folder ({error.strerror}); choose another") from error
    outcomes: list[list[Outcome]] = []
    started = time.perf_counter()
    for number, sweep in enumerate(found):
        if progress is not None:
            left = time_left(started, number, len(found), "sweeps")
            progress(f"{number + 1}/{len(found)} {sweep.name}: {sweep.method}, {sweep.parameter}{left}")
        outcomes.append(follow(sweep))
        allowed = {value: promised(sweep, value) for value in sweep.values if inside(sweep, value)}
        sweep_figure(folder / FIGURES / f"{sweep.name}.{figure_format}", sweep, outcomes[-1], allowed)
    with atomic_path(page) as part:
        part.write_text(_page(found, outcomes, figure_format), encoding="utf-8")
    return page


def check_page(folder: str | os.PathLike[str], *, force: bool) -> Path:
    """Path of the page, checked before the work starts.

    Raises:
        InputError: The page exists, and ``force`` is not given.
    """
    page = require_path(folder, "out") / PAGE
    require_flag(force, "force")
    if is_there(page) and not force:
        raise InputError(f"{page}: exists already; add --force (force=True) to replace it")
    return page


def _page(found: Sequence[Sweep], outcomes: Sequence[Sequence[Outcome]], figure_format: str) -> str:
    import geokit

    parts = [
        "# Where methods fail",
        "",
        f"Written by `geokit bench --stability` (geokit {geokit.__version__}). {INTRODUCTION}",
        "",
        "| method | parameter | holds up to | largest error | wrong answers |",
        "|---|---|---:|---:|---:|",
    ]
    for sweep in found:
        last = sweep.envelope.last
        largest = max(promised(sweep, value) for value in (last, *sweep.values) if inside(sweep, value))
        parts.append(
            f"| [`{sweep.method}`](#{sweep.name}) | {_cell(sweep.parameter)} | {last:g} | "
            f"{_error_cell(largest, sweep.unit)} | {100.0 * sweep.envelope.wrong_share:.3g}% |"
        )
    for sweep, measured in zip(found, outcomes, strict=True):
        parts += _sweep_section(sweep, measured, figure_format)
    return "\n".join(parts) + "\n"


def _sweep_section(sweep: Sweep, measured: Sequence[Outcome], figure_format: str) -> list[str]:
    figure = (FIGURES / f"{sweep.name}.{figure_format}").as_posix()
    shown = "" if figure_format == "pdf" else "!"
    lines = [
        "",
        f'<a id="{sweep.name}"></a>',
        "",
        f"## {sweep.method}: {sweep.parameter}",
        "",
        sweep.envelope.statement,
        "",
        f"{shown}[{_cell(sweep.method)}: error against {_cell(sweep.parameter)}]({figure})",
        "",
        f"| {_cell(sweep.parameter)} | largest error [{_cell(sweep.unit)}] | wrong | promise |",
        "|---:|---:|---:|---|",
    ]
    for outcome in measured:
        error = "-" if math.isnan(outcome.max_error) else f"{outcome.max_error:.2g}"
        if inside(sweep, outcome.value):
            verdict = "kept" if keeps(sweep, outcome) else "**BROKEN**"
        else:
            verdict = "outside, kept" if keeps(sweep, outcome) else "outside"
        if outcome.refusal:
            verdict += f": refused, {_cell(outcome.refusal)}"
        lines.append(f"| {outcome.value:g} | {error} | {100.0 * outcome.wrong_share:.3g}% | {verdict} |")
    return lines


def _error_cell(error: float, unit: str) -> str:
    if unit == NO_UNIT:
        return "-"
    return f"exact [{_cell(unit)}]" if error == 0.0 else f"{error:.2g} {_cell(unit)}"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
