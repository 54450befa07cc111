"""Tables of numbers as text: .csv with a header, .xyz and .txt with spaces."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError
from geokit.formats.decimal import plain_rows

__all__ = ["read_rows", "read_text", "write_text"]

# What UTF-8 files of some programs begin with.
_MARK = b"\xef\xbb\xbf"


def read_text(path: Path) -> tuple[list[str], NDArray[np.float64]]:
    """Column names (empty where the file has none) and the rows as float64, each number rounded correctly.

    Values are separated by commas, semicolons or white space. Names come from a first line that is not numbers, or
    from a last comment line (``#``) above the numbers with as many words as there are columns.

    Raises:
        FileFormatError: A line that is not text, not numbers, or longer or shorter than the first; it is named.
    """
    data = path.read_bytes()
    at = len(_MARK) if data.startswith(_MARK) else 0
    names: list[str] = []
    above, remark = 0, False
    # Only the lines above the numbers are looked at here.
    while at < len(data):
        end = _line_end(data, at)
        line = _decoded(data[at:end], at, path).strip()
        if line.startswith("#"):
            names, remark = _words(line.lstrip("# ")), True
        elif line and _numbers(line) is None:
            names, remark, at, above = _words(line), False, end, above + 1
            break
        elif line:
            break
        at, above = end, above + 1
    table = read_rows(data, at, path)
    if names and table.size and len(names) != table.shape[1]:
        # A remark above the numbers; a header line of another length is an error.
        if not remark:
            raise FileFormatError(
                f"{path}: line {above} names {len(names)} columns and the rows have {table.shape[1]}; name each column"
            )
        names = []
    return names, table


def read_rows(data: bytes, start: int, path: Path) -> NDArray[np.float64]:
    """The rows of numbers from byte ``start`` on, each rounded correctly; ``(0, 1)`` where there are none.

    Raises:
        FileFormatError: A line that is not text, not numbers, or longer or shorter than the first; it is named.
    """
    table = plain_rows(data, start, len(data))
    if table is not None:
        return table
    lines = _decoded(data[start:], start, path).splitlines()
    first = next((text for text in (line.partition("#")[0].strip() for line in lines) if text), "")
    # A separator that is named lets no empty field pass, which white space would close up.
    separator = next((sign for sign in ",;" if sign in first), None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that there are no rows is no news here
            return np.loadtxt(lines, dtype=np.float64, ndmin=2, comments="#", delimiter=separator)
    except ValueError as error:
        _blame(lines, data.count(b"\n", 0, start), path)
        raise FileFormatError(f"{path}: cannot be read as a table of numbers ({error})") from None


def _line_end(data: bytes, start: int) -> int:
    end = data.find(b"\n", start)
    return len(data) if end < 0 else end + 1


def _decoded(text: bytes, start: int, path: Path) -> str:
    try:
        return text.decode("utf-8")
    except UnicodeDecodeError as error:
        raise FileFormatError(
            f"{path}: byte {start + error.start} is not text; the file is damaged or of another format"
        ) from None


def _blame(lines: Sequence[str], above: int, path: Path) -> None:
    """Raises for the first line that is not like the first row."""
    columns = 0
    for number, line in enumerate(lines, above + 1):
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
        file.writelines(
            separator.join(map(repr, row)) + "\n" for row in zip(*(column.tolist() for column in plain), strict=True)
        )
