"""``geokit view``: an interactive page of files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import CycloptsError, Parameter

from geokit.cli._kinds import Columns, FiniteOnly, Flag, UpAxis, kind_of_input, load_shown, may_write, refuse_unused
from geokit.cli._program.console import announce_compiling, note, say, step
from geokit.core.files import require_extension


def view(
    *sources: Annotated[Path, Parameter(name="FILE")],
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    grid: str | None = None,
    up: UpAxis | None = None,
    colormap: str | None = None,
    max_voxels: int | None = None,
    title: str = "",
    device: str | None = None,
    finite_only: FiniteOnly = True,
    columns: Columns = None,
    force: Flag = False,
) -> None:
    """Show meshes, volumes and point clouds in a browser: one HTML file, which needs no network.

    Without --output the page is written to a temporary file and opened.

    Args:
        sources: Meshes, volumes and point clouds.
        output: The .html file to write; it is not opened.
        grid: Name of the grid, if a volume file holds several.
        up: The axis that points up at first; by default that of the first file, as in render.
        colormap: The color map to begin with (viridis, coolwarm, gray, ...).
        max_voxels: Most voxels of a volume's box; larger ones are shown coarser. By default 16,777,216.
        title: Title of the page; by default the names of the files.
        device: Where volumes are read: cpu, cuda:0, ...
        force: Replace an existing output.
    """
    if not sources:
        raise CycloptsError(msg="FILE: none is given; name a mesh, a volume or a point cloud")
    if output is not None:
        require_extension(output, (".html",), "page")
        may_write(output, force=force)
    kinds = [kind_of_input(source, grid) for source in sources]
    if "cloud" not in kinds:
        refuse_unused("without a table of points", columns=columns)
    announce_compiling()
    from geokit.render import _view as drawing

    options: dict[str, Any] = {"title": title, "device": device}
    options |= {} if colormap is None else {"colormap": colormap}
    options |= {} if max_voxels is None else {"max_voxels": max_voxels}
    with step("making the page"):
        read = [load_shown(*pair, grid, finite_only, columns, up) for pair in zip(sources, kinds, strict=True)]
        options["up"] = read[0][1]
        options["names"] = [source.name.encode("utf-8", "replace").decode() for source in sources]
        page = drawing.view(*(thing for thing, _ in read), path=output or drawing.temporary_path(), **options)
    say(f"{page.path}: {len(page.html)} bytes")
    if output is None and not drawing.open_in_browser(page):
        note("no browser opens here; copy the file to where there is one")
