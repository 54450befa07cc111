"""Rows of a table: of plain numbers at once, and of cells one by one, where words or nothing stand among them."""

from __future__ import annotations

import contextlib
import csv
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError
from geokit.formats.text_files.decimal import plain_rows
from geokit.formats.text_files.words import as_number

# A comment, but not the sign in 1.#INF and in a spreadsheet's #N/A.
_COMMENT = re.compile(r"(?<!\d\.)#(?!N/A|NUM!|DIV/0!|VALUE!|REF!|NAME\?|NULL!).*", re.IGNORECASE)
# Two tabulators may have an empty cell between them, which readers at white space would skip.
_SKIPPED = b"\t\t"
# NumPy would read these as comments: 1.#INF, a spreadsheet's #N/A.
_ODD = re.compile(rb"\d\.#|#(?:N/A|NUM!|DIV/0!|VALUE!|REF!|NAME\?|NULL!)", re.IGNORECASE)
# Rows whose words are in memory at a time.
BLOCK = 1 << 16
_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d+,\d+(?:[eE][+-]?\d+)?\s*|\s*\d+\s+[+-]?\d+\s*")


class Cells(NamedTuple):
    """A table whose cells may be no numbers.

    Attributes:
        values: Shape (N, C), float64; NaN where no number stands.
        text: Shape (N, C): cells with a word that is no number.
        empty: Shape (N, C): cells without anything.
        lines: The text of each row's line; empty if all cells are numbers.
        places: Number of each row's line; empty if all cells are numbers.
        separator: What separates the cells of a line; None for white space.
    """

    values: NDArray[np.float64]
    text: NDArray[np.bool_]
    empty: NDArray[np.bool_]
    lines: list[str]
    places: list[int]
    separator: str | None

    def refuse(self, columns: Sequence[int], path: Path) -> None:
        """Check that all cells of some columns are numbers.

        Raises:
            FileFormatError: One is not; the message names its line.
        """
        if not self.lines:
            return
        bad = (self.text | self.empty)[:, list(columns)].any(axis=1)
        if bad.any():
            raise not_numbers(self, int(np.argmax(bad)), path)


def not_numbers(cells: Cells, row: int, path: Path) -> FileFormatError:
    """The error for a row with a cell that is no number."""
    line, shown = cells.places[row], cells.lines[row].strip()[:60]
    if any(map(_DECIMAL_COMMA.fullmatch, split_line(cells.lines[row], cells.separator))):
        remedy = "it seems to have decimal commas; write decimal points"
    else:
        remedy = "correct or remove it"
    return FileFormatError(f"{path}: line {line} ({shown!r}) is not a row of numbers; {remedy}")


def read_rows(data: bytes, start: int, path: Path) -> NDArray[np.float64]:
    """Parse the rows of numbers from byte ``start`` on, each rounded correctly; ``(0, 1)`` if there are none.

    Raises:
        FileFormatError: A line is not text, not numbers, or longer or shorter than the first; the message names it.
    """
    table = _quick(data, start, path)
    if table is not None:
        return table
    cells = _read_cells(data, start, path)
    cells.refuse(range(cells.values.shape[1]), path)
    return cells.values


def read_cells(data: bytes, start: int, path: Path) -> Cells:
    """Parse the rows from byte ``start`` on.

    Raises:
        FileFormatError: A line is not text, or longer or shorter than the first; the message names it.
    """
    table = _quick(data, start, path)
    if table is None:
        return _read_cells(data, start, path)
    none = np.broadcast_to(np.False_, table.shape)
    return Cells(table, none, none, [], [], None)


def _quick(data: bytes, start: int, path: Path) -> NDArray[np.float64] | None:
    """The rows, if all are numbers as NumPy reads them; else None."""
    if b"\t" in data and data.find(_SKIPPED, start) >= 0:
        return None
    table = plain_rows(data, start, len(data))
    if table is not None:
        return table
    if b"#" in data and _ODD.search(data, start):
        return None
    lines = decoded(data[start:], start, path).splitlines()
    first = next((text for text in (line.partition("#")[0].strip() for line in lines) if text), "")
    # With an explicit separator an empty field is an error; splitting at white space would skip it.
    separator = next((sign for sign in ",;" if sign in first), None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a table without rows is handled by the caller
            return np.loadtxt(lines, dtype=np.float64, ndmin=2, comments="#", delimiter=separator)
    except ValueError:
        return None


def decoded(text: bytes, start: int, path: Path) -> str:
    """The text of bytes that begin at ``start`` of a file.

    Raises:
        FileFormatError: They are no text.
    """
    try:
        return text.decode("utf-8")
    except UnicodeDecodeError as error:
        raise FileFormatError(
            f"{path}: byte {start + error.start} is not text in UTF-8; save text in another encoding, such as Latin-1, "
            "as UTF-8, or get a whole copy"
        ) from None


def separator_of(line: str) -> str | None:
    """What separates the cells of a line: a semicolon, a comma, a tabulator, or None for white space."""
    sign = next((sign for sign in ";," if sign in line), None)
    if sign is None and "\t" in line and not any(" " in cell.strip() for cell in line.split("\t")):
        return "\t"
    return sign


def split_line(line: str, separator: str | None) -> list[str]:
    """The cells of a line, without blanks and quotes around them."""
    if separator is None:
        return [word.strip("\"'") for word in line.split()]
    if '"' in line:
        with contextlib.suppress(csv.Error):
            return [word.strip() for word in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]
    return [word.strip() for word in line.split(separator)]


def _read_cells(data: bytes, start: int, path: Path) -> Cells:
    lines: list[str] = []
    places: list[int] = []
    for number, whole in enumerate(decoded(data[start:], start, path).split("\n"), data.count(b"\n", 0, start) + 1):
        line = _COMMENT.sub("", whole).strip(" \r\f\v")
        if line.strip():
            lines.append(line)
            places.append(number)
    if not lines:
        none = np.zeros((0, 1), bool)
        return Cells(np.empty((0, 1)), none, none, [], [], None)
    count = lines[0].strip()
    # Some programs write the number of rows above them.
    is_count = count.isdecimal() and 1 < len(lines) == int(count) + 1
    if is_count and len(split_line(lines[1], separator_of(lines[1]))) > 1:
        del lines[0], places[0]
    separator = separator_of(lines[0])
    if separator == "\t":
        # Tabulators may stand beside other blanks, or several of them between two numbers.
        with contextlib.suppress(FileFormatError):
            cells = _cells(lines, places, separator, path)
            if not cells.empty.all(axis=0).any():
                return cells
        separator = None
    return _cells(lines, places, separator, path)


def _cells(lines: list[str], places: list[int], separator: str | None, path: Path) -> Cells:
    width = len(split_line(lines[0], separator))
    values = np.empty((len(lines), width))
    text, empty = np.empty((len(lines), width), bool), np.empty((len(lines), width), bool)
    for first in range(0, len(lines), BLOCK):
        some = slice(first, first + BLOCK)
        rows = [split_line(line, separator) for line in lines[some]]
        for row, words in enumerate(rows, first):
            if len(words) != width:
                raise _other_width(lines[row], words, places[row], width, path)
        for at, column in enumerate(zip(*rows, strict=True)):
            found = [as_number(word) for word in column]
            values[some, at] = [np.nan if value is None else value for value in found]
            empty[some, at] = [not word for word in column]
            text[some, at] = [value is None and word != "" for value, word in zip(found, column, strict=True)]
    return Cells(values, text, empty, lines, places, separator)


def _other_width(line: str, words: list[str], place: int, width: int, path: Path) -> FileFormatError:
    if all(as_number(word) is None for word in words):
        return FileFormatError(
            f"{path}: line {place} ({line.strip()[:60]!r}) is not a row of numbers; correct or remove it"
        )
    return FileFormatError(f"{path}: line {place} has {len(words)} values and the rows above have {width}; complete it")
