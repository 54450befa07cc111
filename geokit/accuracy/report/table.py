"""results.csv: one row for each method, setting and device; writing and reading."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from geokit.accuracy.trials.model import Measurement
from geokit.core.files import atomic_path, require_file
from geokit.core.require import require_items, require_path
from geokit.errors import FileFormatError

# The attributes of Measurement in order; they are documented there.
COLUMNS = tuple(field.name for field in dataclasses.fields(Measurement) if field.name != "judgement")
_INTEGERS = ("peak_bytes", "byte_count", "checked")
_FLOATS = ("seconds", "spread", "rate", "max_error", "rms_error", "p999_error", "wrong_share")


def write_table(rows: Iterable[Measurement], path: str | os.PathLike[str]) -> Path:
    """Write measurements as CSV; each number is read back bit for bit.

    Args:
        rows: The measurements.
        path: The file.
    Returns:
        The path that was written.
    Raises:
        FileAccessError: The file cannot be written.
    """
    rows = require_items(rows, "rows", Measurement)
    write_rows(path, COLUMNS, map(cells_of, rows))
    return require_path(path)


def write_rows(path: str | os.PathLike[str], columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write names of columns and rows as CSV."""
    with atomic_path(path) as part, open(part, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def cells_of(row: Measurement) -> list[str]:
    """The cells of a row, as text; parameters are JSON."""
    return [_cell(name, getattr(row, name)) for name in COLUMNS]


def _cell(name: str, value: Any) -> str:
    if name == "parameters":
        return json.dumps(dict(value), default=_plain, sort_keys=True)
    return repr(float(value)) if name in _FLOATS else str(value)


def _plain(value: Any) -> Any:
    """Convert values for JSON: NumPy numbers and arrays to Python's, all else to text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def read_table(path: str | os.PathLike[str]) -> list[Measurement]:
    """Read measurements from a results.csv; judgements are not stored there.

    Args:
        path: The file.
    Returns:
        The rows, equal to those that were written.
    Raises:
        FileAccessError: The file is missing or not readable.
        FileFormatError: It is not a table of results; the message names the line.
    """
    with open(require_file(path), encoding="utf-8", newline="") as file:
        reader = csv.reader(file)
        try:
            header = tuple(next(reader, ()))
            if header != COLUMNS:
                raise FileFormatError(f"{path}: line 1 is not the header of results ({', '.join(COLUMNS)})")
            return [_measurement(cells, path, reader.line_num) for cells in reader]
        except (csv.Error, UnicodeDecodeError) as error:
            raise FileFormatError(f"{path}: line {reader.line_num} is not CSV ({error}); write it again") from error


def _measurement(cells: list[str], path: Any, line: int) -> Measurement:
    if len(cells) != len(COLUMNS):
        raise FileFormatError(f"{path}: line {line} has {len(cells)} cells, not {len(COLUMNS)}; write it again")
    values: dict[str, Any] = dict(zip(COLUMNS, cells, strict=True))
    try:
        for name in _INTEGERS:
            values[name] = int(values[name])
        for name in _FLOATS:
            values[name] = float(values[name])
        values["parameters"] = json.loads(values["parameters"])
    except ValueError as error:
        raise FileFormatError(f"{path}: line {line} holds what is not a number ({error}); write it again") from error
    return Measurement(**values)
