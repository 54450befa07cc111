"""``geokit volume``: runs operations on volumes, from file to file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from geokit.cli._console import print_facts, print_json
from geokit.cli._kinds import grid_names, load_grid
from geokit.cli._operate import DEFAULTS, REMEDY, Common, Flag, apply, combine, operation, require_volume_file

__all__ = ["app"]

app = App(name="volume", help="Combine, offset, smooth, resample, differentiate, segment and measure volumes.")

Source = Annotated[Path, Parameter(name="IN")]
Target = Annotated[Path, Parameter(name="OUT")]
Files = Annotated[Path, Parameter(name="FILES")]


@app.command
def union(*files: Files, smooth: float = 0.0, common: Common = DEFAULTS) -> None:
    """Union of two or more level sets: IN IN ... OUT.

    Args:
        files: Two or more .vdb or .nvdb files to read, then the one to write, which gets the first one's grid.
        smooth: Width over which seams are blended, in world units; 0 keeps them sharp.
    """
    combine("union", files, smooth, common)


@app.command
def intersection(*files: Files, smooth: float = 0.0, common: Common = DEFAULTS) -> None:
    """Intersection of two or more level sets: IN IN ... OUT.

    Args:
        files: Two or more .vdb or .nvdb files to read, then the one to write, which gets the first one's grid.
        smooth: Width over which edges are rounded, in world units; 0 keeps them sharp.
    """
    combine("intersection", files, smooth, common)


@app.command
def difference(*files: Files, smooth: float = 0.0, common: Common = DEFAULTS) -> None:
    """Difference of the first level set and all others: IN IN ... OUT.

    Args:
        files: Two or more .vdb or .nvdb files to read, then the one to write, which gets the first one's grid.
        smooth: Width over which edges are rounded, in world units; 0 keeps them sharp.
    """
    combine("difference", files, smooth, common)


@app.command
def offset(source: Source, target: Target, /, *, distance: float, common: Common = DEFAULTS) -> None:
    """Move the surface of a level set outwards, or inwards by a negative distance.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
        distance: Distance in world units.
    """
    apply("offset", source, target, common, distance)


@app.command
def dilate(
    source: Source,
    target: Target,
    /,
    *,
    distance: float | None = None,
    voxels: int | None = None,
    neighbors: str = "faces",
    common: Common = DEFAULTS,
) -> None:
    """Grow a level set by a distance, or the active part of another grid by voxels.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
        distance: Distance for level sets, in world units.
        voxels: Number of steps of one voxel, for other grids.
        neighbors: Neighborhood of a voxel in one step, for other grids: faces, edges or vertices.
    """
    apply("dilate", source, target, common, distance, voxels=voxels, neighbors=neighbors)


@app.command
def erode(
    source: Source,
    target: Target,
    /,
    *,
    distance: float | None = None,
    voxels: int | None = None,
    neighbors: str = "faces",
    common: Common = DEFAULTS,
) -> None:
    """Shrink a level set by a distance, or the active part of another grid by voxels.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
        distance: Distance for level sets, in world units.
        voxels: Number of steps of one voxel, for other grids.
        neighbors: Neighborhood of a voxel in one step, for other grids: faces, edges or vertices.
    """
    apply("erode", source, target, common, distance, voxels=voxels, neighbors=neighbors)


@app.command
def opening(
    source: Source,
    target: Target,
    /,
    *,
    distance: float | None = None,
    voxels: int | None = None,
    neighbors: str = "faces",
    common: Common = DEFAULTS,
) -> None:
    """Erode, then dilate, which removes thin parts.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
        distance: Distance for level sets, in world units.
        voxels: Number of steps of one voxel, for other grids.
        neighbors: Neighborhood of a voxel in one step, for other grids: faces, edges or vertices.
    """
    apply("opening", source, target, common, distance, voxels=voxels, neighbors=neighbors)


@app.command
def closing(
    source: Source,
    target: Target,
    /,
    *,
    distance: float | None = None,
    voxels: int | None = None,
    neighbors: str = "faces",
    common: Common = DEFAULTS,
) -> None:
    """Dilate, then erode, which closes narrow gaps.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
        distance: Distance for level sets, in world units.
        voxels: Number of steps of one voxel, for other grids.
        neighbors: Neighborhood of a voxel in one step, for other grids: faces, edges or vertices.
    """
    apply("closing", source, target, common, distance, voxels=voxels, neighbors=neighbors)


@app.command
def renormalize(
    source: Source, target: Target, /, *, half_width: float | None = None, common: Common = DEFAULTS
) -> None:
    """Recompute the distances of a level set around the same surface.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
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
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
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
    device: str | None = None,
    common: Common = DEFAULTS,
) -> None:
    """Resample a volume to another voxel size, or to the voxels of another volume.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
        voxel_size: New edge length in world units.
        like: A .vdb or .nvdb file with one grid, whose transform is used instead.
        order: Interpolation: 0 nearest voxel, which labels and masks need, 1 trilinear.
        device: Device to compute on: cpu, cuda:0, ...; by default the first GPU, else the CPU.
    """
    transform = None
    if like is not None:
        from geokit.volume import inspect

        require_volume_file(like)
        transform = inspect(like)[0].transform
    apply("resample", source, target, common, voxel_size=voxel_size, transform=transform, order=order, device=device)


@app.command
def prune(source: Source, target: Target, /, *, tolerance: float = 0.0, common: Common = DEFAULTS) -> None:
    """Replace nodes of nearly constant value by tiles.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
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
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
        lower: Lower corner in world units: x y z.
        upper: Upper corner in world units: x y z.
    """
    apply("clip", source, target, common, [lower, upper], within=[lower, upper])


@app.command
def gradient(source: Source, target: Target, /, *, device: str | None = None, common: Common = DEFAULTS) -> None:
    """Compute the gradient of a scalar volume at its active voxels.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
        device: Device to compute on: cpu, cuda:0, ...; by default the first GPU, else the CPU.
    """
    apply("gradient_field", source, target, common, device=device)


@app.command
def divergence(source: Source, target: Target, /, *, device: str | None = None, common: Common = DEFAULTS) -> None:
    """Compute the divergence of a vector volume at its active voxels.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
        device: Device to compute on: cpu, cuda:0, ...; by default the first GPU, else the CPU.
    """
    apply("divergence", source, target, common, device=device)


@app.command
def curl(source: Source, target: Target, /, *, device: str | None = None, common: Common = DEFAULTS) -> None:
    """Compute the curl of a vector volume at its active voxels.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
        device: Device to compute on: cpu, cuda:0, ...; by default the first GPU, else the CPU.
    """
    apply("curl", source, target, common, device=device)


@app.command
def laplacian(source: Source, target: Target, /, *, device: str | None = None, common: Common = DEFAULTS) -> None:
    """Compute the Laplacian of a scalar volume at its active voxels.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
        device: Device to compute on: cpu, cuda:0, ...; by default the first GPU, else the CPU.
    """
    apply("laplacian", source, target, common, device=device)


@app.command
def connected_components(
    source: Source, target: Target, /, *, device: str | None = None, common: Common = DEFAULTS
) -> None:
    """Write a grid of labels: 1 for the largest connected component of a volume, 2 for the next one.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
        device: Device to compute on: cpu, cuda:0, ...; by default the first GPU, else the CPU.
    """
    apply("connected_components", source, target, common, device=device)


@app.command
def segment(source: Source, target: Target, /, *, device: str | None = None, common: Common = DEFAULTS) -> None:
    """Write the connected components of a volume as grids of one file, largest first.

    Args:
        source: The .vdb or .nvdb file to read.
        target: The .vdb or .nvdb file to write.
        device: Device to compute on: cpu, cuda:0, ...; by default the first GPU, else the CPU.
    """
    apply("segment", source, target, common, device=device)


@app.command
def statistics(source: Source, /, *, grid: str | None = None, json: Flag = False) -> None:
    """Print count, extrema, mean and standard deviation of the active voxels; area and volume of a level set.

    Args:
        source: A .vdb or .nvdb file.
        grid: Name of the grid, if the file holds several; all for each of them, as a list in JSON.
        json: Print JSON.
    """
    require_volume_file(source)
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
