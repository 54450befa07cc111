"""Tables of numbers as text: .csv with a header, .xyz and .txt with spaces."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError

__all__ = ["read_text", "write_text"]


def read_text(path: Path) -> tuple[list[str], NDArray[np.float64]]:
    """Column names (empty where the file has none) and the rows as float64.

    Values are separated by commas, semicolons or white space. Names come from a first line that is not numbers, or
    from a last comment line (``#``) above the numbers with as many words as there are columns.

    Raises:
        FileFormatError: A line that is not text, not numbers, or longer or shorter than the first; it is named.
    """
    try:
        lines = path.read_bytes().decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise FileFormatError(
            f"{path}: byte {error.start} is not text; the file is damaged or of another format"
        ) from None
    names: list[str] = []
    start = 0
    for start, line in enumerate(lines):
        text = line.strip()
        if text.startswith("#"):
            names = _words(text.lstrip("# "))
        elif text and _numbers(text) is None:
            names, start = _words(text), start + 1
            break
        elif text:
            break
    else:
        start = len(lines)
    table = _rows(lines, start, path)
    if names and table.size and len(names) != table.shape[1]:
        # A remark above the numbers; a header line of another length is an error.
        if not lines[start - 1].strip().startswith("#"):
            raise FileFormatError(
                f"{path}: line {start} names {len(names)} columns and the rows have {table.shape[1]}; name each column"
            )
        names = []
    return names, table


def _rows(lines: Sequence[str], start: int, path: Path) -> NDArray[np.float64]:
    text = [_spaced(line) for line in lines[start:]]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that there are no rows is no news here
            return np.loadtxt(text, dtype=np.float64, ndmin=2, comments="#")
    except ValueError as error:
        _blame(lines, start, path)
        raise FileFormatError(f"{path}: cannot be read as a table of numbers ({error})") from None


def _blame(lines: Sequence[str], start: int, path: Path) -> None:
    """Raises for the first line that is not like the first row."""
    columns = 0
    for number, line in enumerate(lines[start:], start + 1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        values = _numbers(text)
        if values is None:
            raise FileFormatError(
                f"{path}: line {number} ('{text[:60]}') is not a row of numbers; correct or remove it"
            )
        columns = columns or len(values)
        if len(values) != columns:
            raise FileFormatError(
                f"{path}: line {number} has {len(values)} values and the rows above have {columns}; complete it"
            )


def _spaced(line: str) -> str:
    return line.replace(",", " ").replace(";", " ")


def _words(line: str) -> list[str]:
    for separator in (",", ";"):
        if separator in line:
            return [word.strip().strip('"') for word in line.split(separator)]
    return [word.strip('"') for word in line.split()]


def _numbers(line: str) -> list[float] | None:
    # Empty fields between commas stay words, so that they are refused rather than closed up.
    try:
        return [float(word) for word in _words(line)]
    except ValueError:
        return None


def write_text(path: Path, names: Sequence[str], columns: Sequence[NDArray[np.generic]], *, comma: bool) -> None:
    """Columns with their names above them; every float64 reads back as the same number, True as 1."""
    plain = [column.astype(np.uint8) if column.dtype.kind == "b" else column for column in columns]
    separator = "," if comma else " "
    with open(path, "w", encoding="utf-8") as file:
        file.write(("" if comma else "# ") + separator.join(names) + "\n")
        # tolist gives Python numbers, whose repr has the fewest digits that read back the same.
        for row in zip(*(column.tolist() for column in plain), strict=True):
            file.write(separator.join(map(repr, row)) + "\n")
