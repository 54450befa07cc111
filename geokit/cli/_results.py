"""Writes the answers of a query to a file or stdout, or prints a summary."""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.cli._kinds import may_write
from geokit.cli._program.console import print_facts, print_json
from geokit.core.files import atomic_path, require_extension
from geokit.formats.table import FORMATS, extensions

__all__ = ["OUTPUT_EXTENSIONS", "check_output", "deliver"]

OUTPUT_EXTENSIONS = tuple(sorted(kind for kind in extensions("points", "w") if not FORMATS[kind].limited))
# "-o -" writes CSV to stdout, for pipes.
STDOUT = Path("-")


def check_output(output: Path | None, *, force: bool) -> None:
    """Check the output before the work starts.

    Raises:
        InputError: The extension is unknown, or the file exists and ``force`` is not given.
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
