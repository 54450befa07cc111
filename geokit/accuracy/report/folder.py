"""The report folder: results.csv, figures and report.html."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path

from geokit.accuracy.report.front_figure import front_figure
from geokit.accuracy.report.html import page
from geokit.accuracy.report.plot import plot_of
from geokit.accuracy.report.table import read_table, write_table
from geokit.accuracy.trials.machine import machine_facts, machine_line, version_facts
from geokit.accuracy.trials.model import Measurement
from geokit.accuracy.trials.results import Failure, Group, Results, grouped
from geokit.core.base.private_folder import private_folder
from geokit.core.files import is_there
from geokit.core.memory.needs import needs
from geokit.core.require import require_choice, require_flag, require_items, require_path
from geokit.errors import FileAccessError, GeokitError, InputError
from geokit.render.looks.checks import FLAT

TABLE, PAGE, FIGURES = "results.csv", "report.html", "figures"
FORMATS = tuple(kind[1:] for kind in FLAT)


@needs(lambda *_, **__: 30 << 20, fatal=True)  # of the charts' library
def write_report(
    measurements: Sequence[Measurement],
    out: str | os.PathLike[str],
    *,
    force: bool = False,
    pictures: bool = True,
    figure_format: str = "png",
) -> Path:
    """Write results.csv, a figure for each chart and subject, and one self-contained HTML page.

    A new folder appears complete or not at all. In an existing folder nothing is replaced before everything is made;
    then files are moved into place one by one, the page last. With ``force``, the files of an earlier report are
    replaced, and figures that this report does not have are removed; other files in the folder are kept.

    Args:
        measurements: Result of ``run``, or rows from ``read_table``, which lack titles, pictures and failures.
        out: The folder; created if missing.
        force: Replace the report in a folder that is not empty.
        pictures: Draw error maps. They need OpenGL; without it the page says why there are none.
        figure_format: Of the figures in the folder: "png", "svg" or "pdf". The page has charts of its own.
    Returns:
        Path of the page.
    Raises:
        InputError: There is nothing to report, figure_format is none of these, or the folder is not empty and ``force``
            is not given.
        FileAccessError: The folder cannot be written.
    """
    require_flag(pictures, "pictures")
    require_choice(figure_format, "figure_format", FORMATS)
    folder = check_folder(out, force=force)
    rows = require_items(measurements, "measurements", Measurement)
    results = measurements if isinstance(measurements, Results) else Results(rows)
    if not results and not results.failures:
        raise InputError("measurements: empty: there is nothing to report")
    groups = grouped(results)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        # Inside an existing folder, which may be a separate file system; otherwise beside the folder to be created.
        with private_folder(folder if folder.is_dir() else folder.parent) as private:
            made = private / "report"
            made.mkdir()
            write_table(results, made / TABLE)
            (made / FIGURES).mkdir()
            line = machine_line(results.machine or machine_facts())
            for group in groups:
                if (plot := plot_of(group)).marks:
                    front_figure(made / FIGURES / f"{group.slug}.{figure_format}", group, plot, line)
            _write_page(made / PAGE, groups, results, pictures)
            _publish(made, folder)
    except OSError as error:
        if isinstance(error, GeokitError):
            raise
        raise FileAccessError(f"{folder}: writing failed ({error.strerror or error}); check the disk") from error
    return folder / PAGE


def check_folder(out: str | os.PathLike[str], *, force: bool) -> Path:
    """Check that the folder can be used, before the work starts.

    Raises:
        InputError: The folder is not empty, and ``force`` is not given.
        FileAccessError: The path is a file.
    """
    # "." and "report/.." have no name to derive a temporary name from.
    folder = require_path(out, "out").resolve()
    require_flag(force, "force")
    if is_there(folder) and not folder.is_dir():
        raise FileAccessError(f"{out}: is a file, not a folder; choose another")
    if folder.is_dir() and any(folder.iterdir()) and not force:
        raise InputError(f"{out}: is not empty; choose another folder, or add --force (force=True) to replace a report")
    return folder


def _write_page(target: Path, groups: list[Group], results: Results, pictures: bool) -> None:
    from geokit.accuracy.report.error_figures import pictures_of

    drawn, reason = pictures_of(groups, results.subjects) if pictures else ({}, "")
    failures = list(results.failures)
    if reason:
        failures.append(Failure("maps of the errors", "", "", "", "", reason))
    machine, versions = results.machine or machine_facts(), results.versions or version_facts()
    target.write_text(page(groups, failures, drawn, machine, versions), encoding="utf-8")


def _publish(made: Path, folder: Path) -> None:
    if made.parent.parent != folder:
        os.rename(made, folder)
        return
    stale = _figures_of(folder) - {path.name for path in (made / FIGURES).iterdir()}
    (folder / FIGURES).mkdir(exist_ok=True)
    for path in sorted((made / FIGURES).iterdir()):
        os.replace(path, folder / FIGURES / path.name)
    os.replace(made / TABLE, folder / TABLE)
    os.replace(made / PAGE, folder / PAGE)
    for name in stale:
        (folder / FIGURES / name).unlink(missing_ok=True)


def _figures_of(folder: Path) -> set[str]:
    """Names of the figures that belong to the report in ``folder``, according to its table."""
    with contextlib.suppress(GeokitError, OSError):
        slugs = [group.slug for group in grouped(read_table(folder / TABLE))]
        return {name for slug in slugs for kind in FORMATS if (folder / FIGURES / (name := f"{slug}.{kind}")).is_file()}
    return set()
