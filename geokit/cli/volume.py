"""``geokit volume``: runs operations on volumes, from file to file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from geokit.cli._kinds import Device, Flag, grid_names, load_grid, require_kind
from geokit.cli._operate import DEFAULTS, REMEDY, Common, apply, combine, operation
from geokit.cli._program.console import print_facts, print_json

__all__ = ["app"]

app = App(name="volume", help="Combine, offset, smooth, resample, differentiate, segment and measure volumes.")

Source = Annotated[Path, Parameter(name="IN", help="The .vdb or .nvdb file to read.")]
Target = Annotated[Path, Parameter(name="OUT", help="The .vdb or .nvdb file to write.")]
FILES = "Two or more .vdb or .nvdb files to read, then the one to write, which gets the first one's grid."
Files = Annotated[Path, Parameter(name="FILES", help=FILES)]


def _combining(name: str, text: str, seams: str) -> None:
    """Add a command that combines level sets."""

    def run(*files: Files, smooth: float = 0.0, common: Common = DEFAULTS) -> None:
        combine(name, files, smooth, common)

    run.__doc__ = f"""{text}: IN IN ... OUT.

    Args:
        smooth: Width over which {seams}, in world units; 0 keeps them sharp.
    """
    app.command(run, name=name)


_combining("union", "Union of two or more level sets", "seams are blended")
_combining("intersection", "Intersection of two or more level sets", "edges are rounded")
_combining("difference", "Difference of the first level set and all others", "edges are rounded")


@app.command
def offset(source: Source, target: Target, /, *, distance: float, common: Common = DEFAULTS) -> None:
    """Move the surface of a level set outwards, or inwards by a negative distance.

    Args:
        distance: Distance in world units.
    """
    apply("offset", source, target, common, distance)


def _growing(name: str, text: str) -> None:
    """Add a command that moves surfaces by a distance, or borders by voxels."""

    def run(
        source: Source,
        target: Target,
        /,
        *,
        distance: float | None = None,
        voxels: int | None = None,
        neighbors: str = "faces",
        common: Common = DEFAULTS,
    ) -> None:
        apply(name, source, target, common, distance, voxels=voxels, neighbors=neighbors)

    run.__doc__ = f"""{text}.

    Args:
        distance: Distance for level sets, in world units.
        voxels: Number of steps of one voxel, for other grids.
        neighbors: Neighborhood of a voxel in one step, for other grids: faces, edges or vertices.
    """
    app.command(run, name=name)


_growing("dilate", "Grow a level set by a distance, or the active part of another grid by voxels")
_growing("erode", "Shrink a level set by a distance, or the active part of another grid by voxels")
_growing("opening", "Erode, then dilate, which removes thin parts")
_growing("closing", "Dilate, then erode, which closes narrow gaps")


@app.command
def renormalize(
    source: Source, target: Target, /, *, half_width: float | None = None, common: Common = DEFAULTS
) -> None:
    """Recompute the distances of a level set around the same surface.

    Args:
        half_width: Width of the band on each side in voxels; by default unchanged.
    """
    apply("renormalize", source, target, common, half_width=half_width)


@app.command
def smooth(
    source: Source,
    target: Target,
    /,
    *,
    method: str = "gaussian",
    width: int = 1,
    iterations: int = 1,
    common: Common = DEFAULTS,
) -> None:
    """Smooth a level set or another scalar volume.

    Args:
        method: gaussian, mean or median; for level sets also mean_curvature or laplacian.
        width: Half the filter's side in voxels.
        iterations: Number of times that the filter is applied.
    """
    apply("smooth", source, target, common, method, width=width, iterations=iterations)


@app.command
def resample(
    source: Source,
    target: Target,
    /,
    *,
    voxel_size: float | None = None,
    like: Path | None = None,
    order: int = 1,
    device: Device = None,
    common: Common = DEFAULTS,
) -> None:
    """Resample a volume to another voxel size, or to the voxels of another volume.

    Args:
        voxel_size: New edge length in world units.
        like: A .vdb or .nvdb file with one grid, whose transform is used instead.
        order: Interpolation: 0 nearest voxel, which labels and masks need, 1 trilinear.
    """
    transform = None
    if like is not None:
        from geokit.volume import inspect

        require_kind(like, "volume")
        transform = inspect(like)[0].transform
    apply("resample", source, target, common, voxel_size=voxel_size, transform=transform, order=order, device=device)


@app.command
def prune(source: Source, target: Target, /, *, tolerance: float = 0.0, common: Common = DEFAULTS) -> None:
    """Replace nodes of nearly constant value by tiles.

    Args:
        tolerance: Largest difference of the values that a tile replaces.
    """
    apply("prune", source, target, common, tolerance)


@app.command
def clip(
    source: Source,
    target: Target,
    /,
    *,
    lower: tuple[float, float, float],
    upper: tuple[float, float, float],
    common: Common = DEFAULTS,
) -> None:
    """Keep the part of a volume inside a box. Of a .nvdb that is not compressed only that part is read.

    Args:
        lower: Lower corner in world units: x y z.
        upper: Upper corner in world units: x y z.
    """
    apply("clip", source, target, common, [lower, upper], within=[lower, upper])


def _deriving(name: str, text: str, verb: str) -> None:
    """Add a command that computes a grid on a device."""

    def run(source: Source, target: Target, /, *, device: Device = None, common: Common = DEFAULTS) -> None:
        apply(verb, source, target, common, device=device)

    run.__doc__ = text
    app.command(run, name=name)


for _name, _text in {
    "gradient": "Compute the gradient of a scalar volume at its active voxels.",
    "divergence": "Compute the divergence of a vector volume at its active voxels.",
    "curl": "Compute the curl of a vector volume at its active voxels.",
    "laplacian": "Compute the Laplacian of a scalar volume at its active voxels.",
    "connected-components": (
        "Write a grid of labels: 1 for the largest connected component of a volume, 2 for the next one."
    ),
    "segment": "Write the connected components of a volume as grids of one file, largest first.",
}.items():
    _deriving(_name, _text, "gradient_field" if _name == "gradient" else _name.replace("-", "_"))


@app.command
def statistics(source: Source, /, *, grid: str | None = None, json: Flag = False) -> None:
    """Print count, extrema, mean and standard deviation of the active voxels; area and volume of a level set.

    Args:
        grid: Name of the grid, if the file holds several; all for each of them, as a list in JSON.
        json: Print JSON.
    """
    require_kind(source, "volume")
    names, reports = grid_names(source, grid), []
    for name in [grid] if names is None else names:
        volume = load_grid(source, name, remedy=REMEDY)
        found = operation("statistics")(volume)
        reports.append({"file": str(source), "grid": volume.info.name, **found._asdict()})
    if json:
        print_json(reports[0] if names is None else reports)
        return
    for number, report in enumerate(reports):
        if number:
            print()
        print_facts({name: value for name, value in report.items() if value is not None})
