"""Runs the operations of ``geokit volume``: from files to a file, with a summary."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import CycloptsError, Parameter

from geokit.cli._kinds import grid_names, kind_of_output, load_grid, may_write, require_kind
from geokit.cli._program.console import announce_compiling, print_json, say, step
from geokit.cli._results import Common as Writing
from geokit.errors import GeokitError, InputError

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

__all__ = ["DEFAULTS", "REMEDY", "Common", "apply", "combine", "operation"]


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


def combine(name: str, files: tuple[Path, ...], smooth: float, common: Common) -> None:
    """Run an operation on all files but the last, and write the result to the last.

    Raises:
        CycloptsError: There are fewer than three files.
    """
    if len(files) < 3:
        raise CycloptsError(msg=f"{name}: {len(files)} files given; name at least two to read and then one to write")
    apply(name, files[:-1], files[-1], common, smooth=smooth)


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
