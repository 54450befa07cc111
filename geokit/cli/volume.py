"""``geokit volume``: runs operations on volumes, from file to file."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, CycloptsError, Parameter

from geokit.cli._kinds import Device, Flag, grid_names, kind_of_output, load_grid, may_write, require_kind
from geokit.cli._program.console import announce_compiling, print_facts, print_json, say, step
from geokit.cli._results import Common as Writing
from geokit.errors import GeokitError, InputError

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

app = App(name="volume", help="Combine, offset, smooth, resample, differentiate, segment and measure volumes.")

Source = Annotated[Path, Parameter(name="IN", help="The .vdb or .nvdb file to read.")]
Target = Annotated[Path, Parameter(name="OUT", help="The .vdb or .nvdb file to write.")]
FILES = "Two or more .vdb or .nvdb files to read, then the one to write, which gets the first one's grid."
Files = Annotated[Path, Parameter(name="FILES", help=FILES)]


@Parameter(name="*")
@dataclass(frozen=True)
class Common(Writing):
    """Options of all operations that write a volume."""

    grid: str | None = None
    """Name of the grid, if a file holds several; all for each of them."""
    codec: str | None = None
    """Compression: none, zip or blosc; by default blosc for .vdb and none for .nvdb."""


DEFAULTS = Common()
REMEDY = "--grid chooses another, --grid all takes all"


def operation(name: str) -> Callable[..., Any]:
    """Return a function of ``geokit.volume`` without importing the rest of it."""
    import geokit.volume

    return getattr(geokit.volume, name)


def apply(
    name: str,
    source: Path | tuple[Path, ...],
    target: Path,
    common: Common,
    *arguments: Any,
    within: Any = None,
    **options: Any,
) -> None:
    """Run an operation on one file or several, or on what they have ``within`` a box [world], and write the result."""
    from geokit.volume import save

    sources = (source,) if isinstance(source, Path) else source
    for source in sources:
        require_kind(source, "volume")
    if kind_of_output(target) != "volume":
        raise InputError(f"{target}: operations give volumes; use .vdb or .nvdb, and geokit convert for other formats")
    may_write(target, "volume", force=common.force)
    announce_compiling()
    with step(f"reading {', '.join(map(str, sources))}", quiet=common.json):
        names = grid_names(sources[0], common.grid)
        if names is not None and len(sources) > 1:
            raise InputError(f"--grid: all goes with operations on one file, and {name} takes several; name a grid")
        # Grids of one file are made one by one, since the operation takes one.
        sets = [
            [load_grid(source, grid, bounds=within, remedy=REMEDY) for source in sources]
            for grid in ([common.grid] if names is None else names)
        ]
    made = []
    with step(name, quiet=common.json):
        for volumes in sets:
            with _named(sources[0], volumes[0].info.name, names):
                result = operation(name)(*volumes, *arguments, **options)
            # Of several outputs the volume comes first.
            found = result if isinstance(result, list) else [result[0] if isinstance(result, tuple) else result]
            if not found and names is None:
                raise InputError(
                    f"{sources[0]}: grid {volumes[0].info.name!r} has no active voxels, so there is nothing to write"
                )
            made += found
    if not made:
        raise InputError(f"{sources[0]}: its grids have no active voxels, so there is nothing to write")
    with step(f"writing {target}", quiet=common.json):
        save(target, *made, codec=common.codec)
    _report(name, sources, target, made, common)


@contextlib.contextmanager
def _named(source: Path, grid: str, names: list[str] | None) -> Iterator[None]:
    """Where all grids are meant, let errors say which one they are about."""
    try:
        yield
    except GeokitError as error:
        if names is None:
            raise
        raise type(error)(f"{source}: grid {grid!r}: {error} (--grid takes one that fits)") from error


def _report(name: str, sources: tuple[Path, ...], target: Path, made: list[SparseVolume], common: Common) -> None:
    summary = {
        "grids": len(made),
        "grid_type": " + ".join(dict.fromkeys(volume.info.grid_type for volume in made)),
        "voxel_size": made[0].info.voxel_size.tolist(),
        "active_voxels": [volume.info.active_voxel_count for volume in made],
        "byte_count": target.stat().st_size,
    }
    if common.json:
        print_json(
            {"operation": name, "sources": [str(source) for source in sources], "target": str(target), **summary}
        )
        return
    size = " x ".join(f"{edge:.6g}" for edge in summary["voxel_size"])
    counts = " + ".join(str(count) for count in summary["active_voxels"])
    say(f"{target}: {summary['grid_type']}, {counts} active voxels of {size}, {summary['byte_count']} bytes")


def _combining(name: str, text: str, seams: str) -> None:
    """Add a command that combines level sets."""

    def run(*files: Files, smooth: float = 0.0, common: Common = DEFAULTS) -> None:
        if len(files) < 3:
            what = f"{name}: {len(files)} files given; name at least two to read and then one to write"
            raise CycloptsError(msg=what)
        apply(name, files[:-1], files[-1], common, smooth=smooth)

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
