"""``geokit bench``: charts of accuracy against speed on the user's data, and sweeps to where methods fail."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from geokit.cli._kinds import Flag, kind_of_input, load_cloud, load_grid
from geokit.cli._program.console import announce_compiling, note, print_json, print_table, say
from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.accuracy import Results, Subject

Names = Annotated[list[str] | None, Parameter(negative="")]


def bench(
    *sources: Annotated[Path, Parameter(name="IN")],
    out: Path = Path("report"),
    quick: Flag = False,
    device: Names = None,
    chart: Names = None,
    grid: str | None = None,
    columns: str | None = None,
    stability: Flag = False,
    figures: Literal["png", "svg", "pdf"] = "png",
    force: Flag = False,
    json: Flag = False,
) -> int:
    """Chart accuracy against speed: write results.csv, figures, and a page that recommends a method per tolerance.

    Args:
        sources: Your meshes, volumes and point clouds; by default the samples.
        out: Folder for the report; created if missing.
        quick: Fewer settings and shorter timing: under a minute for the samples on two cores.
        device: Device to compute on: cpu, cuda:0, ...; may be given several times; by default every device.
        chart: Name of a chart to make; may be given several times; by default all charts.
        grid: Name of the grid, if a volume file holds several.
        columns: From tables of points (.csv .xyz .txt): names of the columns of x, y and z, as in east,north,up; by
            default their names tell.
        stability: Write stability.md instead: sweeps towards failure, and the envelope that each method promises.
        figures: Format of the figures beside the page.
        force: Replace an earlier report.
        json: Print the rows as JSON.
    """
    started = time.perf_counter()
    if stability:
        if sources or quick or chart or grid or columns or json or len(device or ()) > 1:
            raise InputError(
                "--stability: sweeps have their own inputs; give --out, --device, --figures and --force only"
            )
        _stability(out, device[0] if device else None, figures, force=force)
        note(f"done in {time.perf_counter() - started:.1f} s")
        return 0
    from geokit.accuracy import run, write_report
    from geokit.accuracy.report.folder import check_folder

    check_folder(out, force=force)
    subjects = [_subject(source, grid, columns) for source in sources] or None
    announce_compiling()
    results = run(subjects, devices=device, quick=quick, charts=chart, progress=note)
    page = write_report(results, out, force=force, figure_format=figures)
    if json:
        from geokit.accuracy.report.table import COLUMNS

        print_json([{name: getattr(row, name) for name in COLUMNS} for row in results])
    else:
        _print_fronts(results)
        say(f"{len(results)} rows, {len(results.failures)} failures: {page}")
    note(f"done in {time.perf_counter() - started:.1f} s")
    # A page with failures only does not count as success.
    return 0 if results else 1


def _stability(out: Path, device: str | None, figures: str, *, force: bool) -> None:
    from geokit.accuracy import write_stability
    from geokit.accuracy.stability.follow_sweeps import check_page

    check_page(out, force=force)
    announce_compiling()
    say(str(write_stability(out, force=force, device=device, progress=note, figure_format=figures)))


def _subject(source: Path, grid: str | None, columns: str | None) -> "Subject":
    from geokit.accuracy import Subject

    kind = kind_of_input(source)
    if kind == "volume":
        return Subject(source.name, volume=load_grid(source, grid))
    if grid is not None:
        raise InputError(f"--grid is for volumes, and {source} is a {kind}; leave it out")
    if kind == "mesh":
        from geokit.mesh import load

        return Subject(source.name, mesh=load(source))
    return Subject(source.name, points=load_cloud(source, columns=columns).points)


def _print_fronts(results: "Results") -> None:
    """Print the methods on each chart's Pareto front."""
    from geokit.accuracy.report.pareto import cost_of, front_of
    from geokit.accuracy.report.text import bytes_text, error_text, seconds_text, share_text
    from geokit.accuracy.trials.results import grouped

    for group in grouped(results):
        duration = "a call" if group.per_call else "each"
        columns = ("method", "setting", "device", duration, "max error", "wrong", "memory")
        cells: list[tuple[str, ...]] = []
        for device in dict.fromkeys(row.device for row in group.rows):
            rows = [row for row in group.rows if row.device == device]
            for place in front_of(rows, group.chart.vertical, group.per_call):
                row = rows[place]
                memory = bytes_text(row.byte_count + row.peak_bytes)
                cells.append((row.method, row.setting, row.device, seconds_text(cost_of(row, group.per_call)),
                              error_text(row.max_error), share_text(row.wrong_share), memory))  # fmt: skip
        print_table(columns, cells, title=f"{group.chart.title}: {group.subject} [{group.chart.unit}]")
        print()
    for failure in results.failures:
        from geokit.accuracy.report.html import failure_text

        note(failure_text(failure))
