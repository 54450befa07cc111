"""``geokit demo``: runs the whole chain on a real mesh."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from geokit.cli._kinds import Device, Flag
from geokit.cli._program.console import announce_compiling, note, print_json, print_table, say
from geokit.errors import FileAccessError, InputError

if TYPE_CHECKING:
    from geokit.cli._demo.steps import DemoLog

OUTPUTS = (
    "sdf.nvdb",
    "sdf.vdb",
    "points.vtp",
    "mesh.vtu",
    "surface.png",
    "raycast.png",
    "slice.png",
    "neighbors.png",
    "accuracy.csv",
    "accuracy.png",
    "summary.csv",
    "summary.md",
)
FLAT_FIGURES = ("slice.png", "accuracy.png")


def demo(
    *,
    out: Path = Path("demo"),
    mesh: Path | None = None,
    device: Device = None,
    figures: Literal["png", "svg", "pdf"] = "png",
    force: Flag = False,
    json: Flag = False,
) -> None:
    """Run the whole chain on a real mesh; write files, figures and a table of accuracy and speed.

    Args:
        out: Folder for the results; created if missing.
        mesh: A mesh file; by default the Stanford bunny.
        figures: Format of the chart of accuracy and of the slice; pictures of surfaces are .png always.
        force: Replace earlier results in the folder.
        json: Print the closing table as JSON.
    """
    outputs = [name.replace(".png", f".{figures}") if name in FLAT_FIGURES else name for name in OUTPUTS]
    existing = [name for name in outputs if (out / name).exists()]
    if existing and not force:
        raise InputError(f"{out}: holds {existing[0]} from an earlier run; add --force to replace it")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileAccessError(f"{out}: cannot be made a folder ({error.strerror}); choose another --out") from error
    started = time.perf_counter()
    announce_compiling()
    log = run_chain(out, mesh, device, figures, quiet=json)
    log.write(out)
    if json:
        print_json(log.entries)
        return
    from geokit.cli._demo.steps import COLUMNS

    print()
    print_table(COLUMNS, [entry.cells() for entry in log.entries])
    print()
    written = [name for name in outputs if (out / name).exists()]
    say(f"{len(written)} files in {out}: {', '.join(written)}")
    note(f"done in {time.perf_counter() - started:.1f} s")


def run_chain(out: Path, mesh_path: Path | None, device: str | None, figure_format: str, *, quiet: bool) -> "DemoLog":
    """Run every step of the demo and return its log."""
    from geokit.cli._demo import figures, steps
    from geokit.cli._demo.input import load_mesh
    from geokit.cli._demo.steps import DemoLog
    from geokit.mesh import Surface, audit

    log = DemoLog(quiet=quiet)
    with log.step("load the mesh", "faces") as entry:
        mesh, origin = load_mesh(mesh_path)
        entry.count = len(mesh.faces)
    if not quiet:
        note(f"input: {origin}")
    with log.step("audit it", "faces") as entry:
        report = audit(mesh)
        entry.count = report.face_count
    entry.reference = (
        f"watertight: {_yes(report.watertight)}, manifold: {_yes(report.manifold)}, "
        f"oriented: {_yes(report.oriented)}, degenerate: {report.degenerate_count}"
    )
    with log.step("prepare the surface", "faces") as entry:
        surface = Surface(mesh, device=device)
        entry.count = len(mesh.faces)
    entry.reference = f"on {surface.device}, sign by {surface.sign_method}"

    steps.warm_up(log, surface, device)
    volume = steps.build_volume(log, surface, device)
    volume = steps.save_and_reload(log, volume, out)
    projection = steps.project_points(log, surface)
    image = steps.cast_image(log, surface)
    steps.sample_volume(log, surface, volume, device)
    neighborhood = steps.find_neighbors(log, mesh, device)
    extracted, deviation = steps.extract_surface(log, surface, volume)
    steps.export(log, surface, volume, projection, out)
    figures.draw_figures(
        figure_format,
        log,
        out,
        extracted=extracted,
        deviation=deviation,
        projection=projection,
        image=image,
        mesh=mesh,
        volume=steps.build_wide_volume(surface),
        neighborhood=neighborhood,
    )
    measured, exact_seconds = steps.accuracy_over_voxel_size(log, surface, device)
    figures.accuracy_chart(out / f"accuracy.{figure_format}", measured, exact_seconds, steps.CHART_POINTS)
    return log


def _yes(value: bool) -> str:
    return "yes" if value else "no"
