"""Answers of a query: into a file, onto stdout, or summed up."""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.cli._console import print_facts, print_json
from geokit.cli._kinds import may_write
from geokit.core.files import atomic_path, require_extension

__all__ = ["OUTPUT_EXTENSIONS", "check_output", "deliver"]

OUTPUT_EXTENSIONS = (".csv", ".npz", ".pcd", ".ply", ".vtp", ".xyz")
# "-o -": CSV on stdout, for pipes.
STDOUT = Path("-")


def check_output(output: Path | None, *, force: bool) -> None:
    """Refuse a target before the work rather than after it.

    Raises:
        InputError: An unknown extension, or a file that exists where ``force`` is not given.
    """
    if output is None or output == STDOUT:
        return
    require_extension(output, OUTPUT_EXTENSIONS, "result")
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
    """Write the answers where they were asked for, and sum them up on stdout.

    Args:
        points: The queries [world], shape (N, 3).
        data: Answers with N rows each, by name.
        summary: What to print where the answers do not themselves go to stdout.
        output: A file, ``-`` for CSV on stdout, or None for the summary alone.
        json: Print the summary as JSON.
        ragged: Arrays of other lengths, which only .npz holds.
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
            # The names that geokit.points.save gives them too.
            columns.update({f"{name}_{axis}": column for axis, column in zip("xyz", values.T, strict=True)})
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
