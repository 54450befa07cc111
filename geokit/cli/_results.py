"""Writes what commands make, answers of queries and meshes, and prints a summary."""

import csv
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from cyclopts import Parameter
from numpy.typing import NDArray

from geokit.cli._kinds import Columns, Device, FiniteOnly, Flag, may_write
from geokit.cli._program.console import print_facts, print_json, say, step
from geokit.core.files import atomic_path, require_extension
from geokit.formats.table import FORMATS, extensions

if TYPE_CHECKING:
    from geokit.mesh import TriangleMesh

OUTPUT_EXTENSIONS = tuple(sorted(kind for kind in extensions("points", "w") if not FORMATS[kind].limited))
# "-o -" writes CSV to stdout, for pipes.
STDOUT = Path("-")
# What a summary says of the distribution; half of the values are below the 50th.
PERCENTILES = (5, 50, 95)

Source = Annotated[Path, Parameter(name="IN")]
Changed = Annotated[Path, Parameter(name="OUT", help="The mesh to write.")]


# Annotations are not postponed in this file: of a class that derives from these in another one they would not be found.
@Parameter(name="*")
@dataclass(frozen=True)
class Common:
    """Options of all commands that write."""

    force: Flag = False
    """Replace an existing output."""
    json: Flag = False
    """Print a summary as JSON."""


@Parameter(name="*")
@dataclass(frozen=True)
class Asking(Common):
    """Options of all commands that read points."""

    device: Device = None
    finite_only: FiniteOnly = True
    columns: Columns = None


DEFAULTS, ASKING = Common(), Asking()


def deliver_mesh(made: "TriangleMesh", target: Path, common: Common, **facts: Any) -> None:
    """Write a mesh, and say what it is."""
    from geokit.mesh import save

    may_write(target, "mesh", force=common.force)
    with step(f"writing {target}", quiet=common.json):
        save(target, made)
    summary = {"target": str(target), "vertices": made.vertex_count, "faces": made.face_count, **facts}
    if common.json:
        print_json(summary)
    else:
        say(described(summary))


def described(summary: Mapping[str, Any]) -> str:
    """A summary in a line, with no more digits than anyone reads."""
    shown = {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in summary.items()}
    return f"{shown['target']}: " + ", ".join(f"{n} {v}" for n, v in shown.items() if n not in ("source", "target"))


def spread(name: str, values: NDArray[Any]) -> dict[str, float]:
    """The distribution of those values that are finite; {} if none is."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return {}
    return {
        f"{name}_min": float(finite.min()),
        f"{name}_mean": float(finite.mean()),
        f"{name}_max": float(finite.max()),
        f"{name}_std": float(finite.std()),
        f"{name}_rms": float(np.sqrt(np.mean(np.square(finite, dtype=np.float64)))),
        **{f"{name}_p{percent}": float(np.percentile(finite, percent)) for percent in PERCENTILES},
    }


def check_output(output: Path | None, *others: str, force: bool) -> None:
    """Check the output, which may have ``others`` as extension, before the work starts.

    Raises:
        InputError: The extension is unknown, or the file exists and ``force`` is not given.
    """
    if output is None or output == STDOUT:
        return
    require_extension(output, (*OUTPUT_EXTENSIONS, *others), "result")
    may_write(output, force=force)


def deliver(
    points: NDArray[np.float64],
    data: Mapping[str, NDArray[Any]],
    summary: Mapping[str, Any],
    output: Path | None,
    *,
    json: bool,
    ragged: Mapping[str, NDArray[Any]] | None = None,
) -> None:
    """Write the answers to the output, and print a summary on stdout.

    Args:
        points: The queries [world], shape (N, 3).
        data: Answers with N rows each, by name.
        summary: Printed unless the answers themselves go to stdout.
        output: A file, ``-`` for CSV on stdout, or None for the summary alone.
        json: Print the summary as JSON.
        ragged: Arrays of other lengths, which only .npz can hold.
    """
    if output == STDOUT:
        _write_csv(sys.stdout, points, data)
        return
    facts = dict(summary)
    if output is not None:
        if output.suffix.lower() == ".npz":
            with atomic_path(output) as part:
                arrays: dict[str, Any] = {"points": points, **data, **(ragged or {})}
                np.savez(part, **arrays)
        else:
            from geokit.points import save

            save(output, points, data=dict(data))
        facts["output"] = str(output)
    if json:
        print_json(facts)
    else:
        print_facts(facts)


def _write_csv(file: Any, points: NDArray[np.float64], data: Mapping[str, NDArray[Any]]) -> None:
    columns: dict[str, NDArray[Any]] = {axis: points[:, index] for index, axis in enumerate("xyz")}
    for name, values in data.items():
        if values.ndim == 1:
            columns[name] = values
        else:
            # The same column names as geokit.points.save writes.
            columns.update({f"{name}_{axis}": column for axis, column in zip("xyz", values.T, strict=True)})
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
