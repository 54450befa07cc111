"""Numbers as text, for all text formats, and tables of them: .csv with a header, .xyz and .txt with spaces."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError
from geokit.formats.columns import Columns, joined, named, rays, split
from geokit.formats.decimal import plain_rows

__all__ = ["numbers", "point_lines", "read_points", "read_rays", "read_rows", "row_lines", "write_points"]

# Byte-order mark with which UTF-8 files of some programs begin.
_MARK = b"\xef\xbb\xbf"


def read_points(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Read the columns x, y and z, or the first three, and the others by name.

    Raises:
        FileFormatError: A line is not text, not numbers, or longer or shorter than the first; the message names it.
    """
    return joined(named(*_read_table(path), path), path)


def read_rays(path: Path) -> NDArray[np.float64]:
    """Read origins and directions (N, 6).

    Raises:
        FileFormatError: As for :func:`read_points`, or fewer than six columns.
    """
    return rays(*_read_table(path), path)


def write_points(path: Path, points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]]) -> None:
    """Write columns below their names; every float64 reads back as the same number, and True as 1.

    Raises:
        InputError: A name cannot be that of a column.
    """
    kind = path.suffix.lower()
    columns = split(points, data, kind)
    plain = [column.astype(np.uint8) if column.dtype.kind == "b" else column for column in columns.values()]
    separator = "," if kind == ".csv" else " "
    with open(path, "w", encoding="utf-8") as file:
        file.write(("" if kind == ".csv" else "# ") + separator.join(columns) + "\n")
        file.writelines(row_lines(plain, separator))


def row_lines(columns: Sequence[NDArray[Any]], separator: str = " ") -> Iterable[str]:
    """Lines of one number from each column, with the fewest digits that read back as the same float64."""
    # tolist gives Python numbers, whose repr has the fewest digits.
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return (separator.join(map(repr, row)) + "\n" for row in rows)


def point_lines(points: NDArray[np.float64], prefix: str = "") -> Iterable[str]:
    """Lines of three numbers with the fewest digits that read back as the same float64."""
    return (f"{prefix}{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist())


def numbers(tokens: list[bytes], dtype: type, path: Path, what: str) -> NDArray[Any]:
    """Convert tokens to an array of ``dtype``, each rounded correctly.

    Raises:
        FileFormatError: A token is not a number of this type; the message names the token and its position.
    """
    if not tokens:
        return np.zeros(0, dtype)
    try:
        return np.array(tokens, dtype=dtype)
    except (ValueError, OverflowError):
        pass
    convert = int if np.issubdtype(dtype, np.integer) else float
    for at, token in enumerate(tokens):
        try:
            np.array(convert(token), dtype=dtype)
        except (ValueError, OverflowError):
            shown = token[:40].decode("ascii", "backslashreplace")
            raise FileFormatError(
                f"{path}: {shown!r} (number {at} of the {what}) is not a number that fits; the file is damaged"
            ) from None
    raise FileFormatError(f"{path}: the {what} cannot be read as numbers; the file is damaged")


def _read_table(path: Path) -> tuple[list[str], NDArray[np.float64]]:
    """Column names (empty if the file has none) and the rows as float64, each number rounded correctly.

    Values are separated by commas, semicolons or white space. Names come from a first line that is not numbers, or from
    a last comment line (``#``) above the numbers with as many words as there are columns.

    Raises:
        FileFormatError: A line is not text, not numbers, or longer or shorter than the first; the message names it.
    """
    data = path.read_bytes()
    at = len(_MARK) if data.startswith(_MARK) else 0
    names: list[str] = []
    above, remark = 0, False
    # Only the lines above the numbers are parsed here.
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
        # A comment above the numbers may have any length; a header line of another length is an error.
        if not remark:
            raise FileFormatError(
                f"{path}: line {above} names {len(names)} columns and the rows have {table.shape[1]}; name each column"
            )
        names = []
    return names, table


def read_rows(data: bytes, start: int, path: Path) -> NDArray[np.float64]:
    """Parse the rows of numbers from byte ``start`` on, each rounded correctly; ``(0, 1)`` if there are none.

    Raises:
        FileFormatError: A line is not text, not numbers, or longer or shorter than the first; the message names it.
    """
    table = plain_rows(data, start, len(data))
    if table is not None:
        return table
    lines = _decoded(data[start:], start, path).splitlines()
    first = next((text for text in (line.partition("#")[0].strip() for line in lines) if text), "")
    # With an explicit separator an empty field is an error; splitting at white space would skip it.
    separator = next((sign for sign in ",;" if sign in first), None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a table without rows is handled by the caller
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
    """Raise the error for the first line that differs from the first row."""
    columns = 0
    for number, line in enumerate(lines, above + 1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        values = _numbers(text)
        if values is None:
            raise FileFormatError(
                f"{path}: line {number} ({text[:60]!r}) is not a row of numbers; correct or remove it"
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
    # Empty fields between commas stay words, so that they are rejected and not skipped.
    try:
        return [float(word) for word in _words(line)]
    except ValueError:
        return None
