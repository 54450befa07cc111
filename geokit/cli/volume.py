"""``geokit volume``: operations on volumes, from file to file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from geokit.cli._console import announce_compiling, print_facts, print_json, step
from geokit.cli._kinds import kind_of_input, kind_of_output, load_grid, may_write
from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.volume.model import SparseVolume

__all__ = ["app"]

app = App(name="volume", help="Combine, move, smooth, resample, differentiate, take apart and measure volumes.")

Source = Annotated[Path, Parameter(name="IN")]
Target = Annotated[Path, Parameter(name="OUT")]
Files = Annotated[Path, Parameter(name="FILES")]
Flag = Annotated[bool, Parameter(negative="")]


@Parameter(name="*")
@dataclass(frozen=True)
class Common:
    """Options of every operation that writes a volume."""

    grid: str | None = None
    """Name of the grid where a file holds several."""
    codec: str | None = None
    """Compression: none, zip or blosc; blosc for .vdb and none for .nvdb where not given."""
    force: Flag = False
    """Replace the output where it exists."""
    json: Flag = False
    """Print a summary as JSON."""


DEFAULTS = Common()


@app.command
def union(*files: Files, smooth: float = 0.0, common: Common = DEFAULTS) -> None:
    """What is inside one of several level sets: IN IN ... OUT.

    Args:
        files: Two or more .vdb or .nvdb files to read, then the one to write, which gets the first one's grid.
        smooth: Width over which seams are blended, in world units; 0 keeps them sharp.
    """
    _combine("union", files, smooth, common)


@app.command
def intersection(*files: Files, smooth: float = 0.0, common: Common = DEFAULTS) -> None:
    """What is inside all of several level sets: IN IN ... OUT.

    Args:
        files: Two or more .vdb or .nvdb files to read, then the one to write, which gets the first one's grid.
        smooth: Width over which edges are rounded, in world units; 0 keeps them sharp.
    """
    _combine("intersection", files, smooth, common)


@app.command
def difference(*files: Files, smooth: float = 0.0, common: Common = DEFAULTS) -> None:
    """What is inside the first level set and outside all others: IN IN ... OUT.

    Args:
        files: Two or more .vdb or .nvdb files to read, then the one to write, which gets the first one's grid.
        smooth: Width over which edges are rounded, in world units; 0 keeps them sharp.
    """
    _combine("difference", files, smooth, common)


@app.command
def offset(source: Source, target: Target, /, *, distance: float, common: Common = DEFAULTS) -> None:
    """Move the surface of a level set outwards, or inwards by a negative distance.

    Args:
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        distance: In world units.
    """
    _apply("offset", source, target, common, distance)


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
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        distance: For level sets, in world units.
        voxels: For other grids.
        neighbors: Which of a voxel's neighbours count in a step of other grids: faces, edges or vertices.
    """
    _apply("dilate", source, target, common, distance, voxels=voxels, neighbors=neighbors)


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
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        distance: For level sets, in world units.
        voxels: For other grids.
        neighbors: Which of a voxel's neighbours count in a step of other grids: faces, edges or vertices.
    """
    _apply("erode", source, target, common, distance, voxels=voxels, neighbors=neighbors)


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
    """Erode, then dilate: thin parts go.

    Args:
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        distance: For level sets, in world units.
        voxels: For other grids.
        neighbors: Which of a voxel's neighbours count in a step of other grids: faces, edges or vertices.
    """
    _apply("opening", source, target, common, distance, voxels=voxels, neighbors=neighbors)


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
    """Dilate, then erode: narrow gaps close.

    Args:
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        distance: For level sets, in world units.
        voxels: For other grids.
        neighbors: Which of a voxel's neighbours count in a step of other grids: faces, edges or vertices.
    """
    _apply("closing", source, target, common, distance, voxels=voxels, neighbors=neighbors)


@app.command
def renormalize(
    source: Source, target: Target, /, *, half_width: float | None = None, common: Common = DEFAULTS
) -> None:
    """Give a level set distances again, around the same surface.

    Args:
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        half_width: Width of the band on each side in voxels; as it is where not given.
    """
    _apply("renormalize", source, target, common, half_width=half_width)


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
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        method: gaussian, mean or median; for level sets also mean_curvature or laplacian.
        width: Half the filter's side in voxels.
        iterations: How often.
    """
    _apply("smooth", source, target, common, method, width=width, iterations=iterations)


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
    """Bring a volume to voxels of another size, or to those of another volume.

    Args:
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        voxel_size: New edge length in world units.
        like: A .vdb or .nvdb file with one grid whose transform is taken instead.
        order: Interpolation: 0 nearest voxel, 1 trilinear.
        device: Where to compute: cpu, cuda:0, ...; the first GPU where not given.
    """
    transform = None
    if like is not None:
        from geokit.volume import inspect

        _require_volume_file(like)
        transform = inspect(like)[0].transform
    _apply("resample", source, target, common, voxel_size=voxel_size, transform=transform, order=order, device=device)


@app.command
def prune(source: Source, target: Target, /, *, tolerance: float = 0.0, common: Common = DEFAULTS) -> None:
    """Replace nodes whose voxels are alike by tiles.

    Args:
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        tolerance: Largest difference of values in a tile.
    """
    _apply("prune", source, target, common, tolerance)


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
    """Keep the part of a volume inside a box.

    Args:
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        lower: Lower corner in world units: x y z.
        upper: Upper corner in world units: x y z.
    """
    _apply("clip", source, target, common, [lower, upper])


@app.command
def gradient(source: Source, target: Target, /, *, device: str | None = None, common: Common = DEFAULTS) -> None:
    """Gradient of a scalar volume at its active voxels.

    Args:
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        device: Where to compute: cpu, cuda:0, ...; the first GPU where not given.
    """
    _apply("gradient_field", source, target, common, device=device)


@app.command
def divergence(source: Source, target: Target, /, *, device: str | None = None, common: Common = DEFAULTS) -> None:
    """Divergence of a vector volume at its active voxels.

    Args:
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        device: Where to compute: cpu, cuda:0, ...; the first GPU where not given.
    """
    _apply("divergence", source, target, common, device=device)


@app.command
def curl(source: Source, target: Target, /, *, device: str | None = None, common: Common = DEFAULTS) -> None:
    """Curl of a vector volume at its active voxels.

    Args:
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        device: Where to compute: cpu, cuda:0, ...; the first GPU where not given.
    """
    _apply("curl", source, target, common, device=device)


@app.command
def laplacian(source: Source, target: Target, /, *, device: str | None = None, common: Common = DEFAULTS) -> None:
    """Laplacian of a scalar volume at its active voxels.

    Args:
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
        device: Where to compute: cpu, cuda:0, ...; the first GPU where not given.
    """
    _apply("laplacian", source, target, common, device=device)


@app.command
def segment(source: Source, target: Target, /, *, common: Common = DEFAULTS) -> None:
    """Write the connected components of a volume as grids of one file, largest first.

    Args:
        source: A .vdb or .nvdb file.
        target: A .vdb or .nvdb file.
    """
    _apply("segment", source, target, common)


@app.command
def statistics(source: Source, /, *, grid: str | None = None, json: Flag = False) -> None:
    """Count, extrema, mean and spread of the active voxels; area and volume of a level set.

    Args:
        source: A .vdb or .nvdb file.
        grid: Name of the grid where the file holds several.
        json: Print JSON.
    """
    _require_volume_file(source)
    volume = load_grid(source, grid)
    found = _operation("statistics")(volume)
    report = {"file": str(source), "grid": volume.info.name, **found._asdict()}
    if json:
        print_json(report)
    else:
        print_facts({name: value for name, value in report.items() if value is not None})


# Where the functions are; `geokit.volume` gives them these names too.
_MODULES = {
    "csg": ("union", "intersection", "difference"),
    "morphology": ("offset", "dilate", "erode", "opening", "closing", "renormalize"),
    "filters": ("smooth",),
    "resample": ("resample",),
    "topology": ("prune", "clip", "segment"),
    "differential": ("gradient_field", "divergence", "curl", "laplacian"),
    "statistics": ("statistics",),
}


def _operation(name: str) -> Callable[..., Any]:
    import importlib

    module = next(module for module, names in _MODULES.items() if name in names)
    return getattr(importlib.import_module(f"geokit.volume.{module}"), name)


def _combine(name: str, files: tuple[Path, ...], smooth: float, common: Common) -> None:
    if len(files) < 3:
        raise InputError(f"{name}: {len(files)} files given; name at least two to read and then one to write")
    _run(name, files[:-1], files[-1], common, smooth=smooth)


def _apply(name: str, source: Path, target: Path, common: Common, *arguments: Any, **options: Any) -> None:
    _run(name, (source,), target, common, *arguments, **options)


def _run(name: str, sources: tuple[Path, ...], target: Path, common: Common, *arguments: Any, **options: Any) -> None:
    from geokit.volume import save

    for source in sources:
        _require_volume_file(source)
    if kind_of_output(target) != "volume":
        raise InputError(f"{target}: operations give volumes; use .vdb or .nvdb, and geokit convert for other formats")
    may_write(target, force=common.force)
    announce_compiling()
    with step(f"reading {', '.join(map(str, sources))}", quiet=common.json):
        volumes = [load_grid(source, common.grid) for source in sources]
    with step(name, quiet=common.json):
        result = _operation(name)(*volumes, *arguments, **options)
    parts = result if isinstance(result, list) else [result]
    if not parts:
        raise InputError(
            f"{sources[0]}: grid {volumes[0].info.name!r} has no active voxels, so there is nothing to write"
        )
    with step(f"writing {target}", quiet=common.json):
        save(target, *parts, codec=common.codec)
    _report(name, sources, target, parts, common)


def _report(name: str, sources: tuple[Path, ...], target: Path, parts: list[SparseVolume], common: Common) -> None:
    summary = {
        "grids": len(parts),
        "grid_type": parts[0].info.grid_type,
        "voxel_size": parts[0].info.voxel_size.tolist(),
        "active_voxels": [part.info.active_voxel_count for part in parts],
        "byte_count": target.stat().st_size,
    }
    if common.json:
        print_json(
            {"operation": name, "sources": [str(source) for source in sources], "target": str(target), **summary}
        )
        return
    size = " x ".join(f"{edge:.6g}" for edge in summary["voxel_size"])
    counts = " + ".join(str(count) for count in summary["active_voxels"])
    print(f"{target}: {summary['grid_type']}, {counts} active voxels of {size}, {summary['byte_count']} bytes")


def _require_volume_file(path: Path) -> None:
    if kind_of_input(path) != "volume":
        raise InputError(f"{path}: not a volume; give a .vdb or .nvdb file, or make one with geokit convert")
