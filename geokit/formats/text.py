"""Tables of points and rays: .csv with a header, .xyz and .txt with spaces."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.files import in_one_line
from geokit.errors import FileFormatError, InputError
from geokit.formats.columns import AXES, RAY_COLUMNS, Columns, first_rays, joined, split
from geokit.formats.text_files.coordinates import coordinate_columns, ray_columns
from geokit.formats.text_files.decimal import written_lines
from geokit.formats.text_files.plain import plain_text
from geokit.formats.text_files.rows import Cells, decoded, not_numbers, read_cells, separator_of, split_line
from geokit.formats.text_files.words import as_number


def read_points(path: Path, columns: Sequence[str] | None = None) -> tuple[NDArray[np.float64], Columns]:
    """Read the coordinates, which their names tell, or ``columns``, and the other columns by name.

    Without names they are the first three columns. Columns of text are left out with a warning.

    Raises:
        FileFormatError: A line is not text, not numbers, or longer or shorter than the first, with its number; the
            names are not those of coordinates; or there is a header without rows that names no coordinates.
        InputError: A name in ``columns`` is none of the file's.
    """
    table = _read_table(path)
    points, data = joined(_named_columns(table, _coordinates(table, columns, path), path), path)
    if "rgb" in data:
        data["rgb"] = _colors(data["rgb"])
    return points, data


def _colors(values: NDArray[np.generic]) -> NDArray[np.generic]:
    """Whole numbers beyond 1 as the shortest type that has them, whose largest number is full brightness."""
    largest = values.max(initial=0.0)
    if not 1.0 < largest <= 65535.0 or values.min() < 0.0 or np.any(values != np.rint(values)):
        return values
    return values.astype(np.uint8 if largest <= 255.0 else np.uint16)


def read_rays(path: Path, columns: Sequence[str] | None = None) -> NDArray[np.float64]:
    """Read origins and directions (N, 6), which their names tell, or ``columns``; without names the first six columns.

    Raises:
        FileFormatError: As for :func:`read_points`, or fewer than six columns.
        InputError: A name in ``columns`` is none of the file's.
    """
    table = _read_table(path)
    names, named, cells = table
    places = _places_of(columns, names, path) if columns is not None else ray_columns(names) if named else None
    if places is not None:
        if not len(cells.values):
            return np.empty((0, 6))
        cells.refuse(places, path)
        return cells.values[:, places]
    _take_first(table, "rays", RAY_COLUMNS, path)
    cells.refuse(range(cells.values.shape[1]), path)
    return first_rays(cells.values, path)


def write_points(path: Path, points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]]) -> None:
    """Write columns below their names; every float64 reads back as the same number, and True as 1.

    Raises:
        InputError: A name cannot be that of a column.
    """
    kind = path.suffix.lower()
    columns = split(points, data, kind)
    separator = "," if kind == ".csv" else " "
    with open(path, "wb") as file:
        file.write((("" if kind == ".csv" else "# ") + separator.join(columns) + "\n").encode())
        file.writelines(written_lines(*columns.values(), separator=separator))


class _Table(NamedTuple):
    """A table: its columns' names, whether a header or a comment names them, and its cells."""

    names: list[str]
    named: Literal["header", "comment", ""]
    cells: Cells


def _read_table(path: Path) -> _Table:
    """Column names and the rows as float64, each number rounded correctly.

    Values are separated by commas, semicolons, tabulators or white space. Names come from a first line without any
    number, or from a last comment line (``#`` or ``//``) above the numbers with as many words as there are columns.
    Columns without a name are called ``column_0``, ``column_1``, ...

    Raises:
        FileFormatError: A line is not text, or longer or shorter than the first; the message names it.
    """
    data = plain_text(path.read_bytes(), path)
    at = above = 0
    names: list[str] = []
    named: Literal["header", "comment", ""] = ""
    # Only the lines above the numbers are parsed here.
    while at < len(data):
        end = data.find(b"\n", at) + 1 or len(data)
        line = decoded(data[at:end], at, path).strip(" \r\n\f\v")
        words = _words(line.lstrip("#/%! "))
        if line.startswith(_REMARKS):
            names, named = words, "comment"
        elif any(words):
            if any(as_number(word) is not None for word in words):
                break
            if above == 0 and _SEPARATOR.fullmatch(line):
                at, above = end, 1
                continue
            names, named, at, above = words, "header", end, above + 1
            break
        at, above = end, above + 1
    cells = read_cells(data, at, path)
    if not len(cells.values):
        if named == "comment" and not set(AXES) <= set(names):
            names = []
    else:
        cells = _without_empty_ends(cells, names)
        width = cells.values.shape[1]
        while len(names) > width and not names[-1]:
            names.pop()
        if named == "header" and len(names) != width:
            raise FileFormatError(
                f"{path}: line {above} names {len(names)} columns and the rows have {width}; name each column"
            )
        # A comment above the numbers may have any words.
        if len(names) != width or (named == "comment" and len(set(names)) < width):
            names, named = [], ""
        names = [name or f"column_{at}" for at, name in enumerate(names or [""] * width)]
    return _Table(names, named, cells)


_REMARKS = ("#", "//", "%")


def _without_empty_ends(cells: Cells, names: list[str]) -> Cells:
    """The cells without columns at the ends that hold nothing and have no name, as of separators at ends of lines."""
    if not cells.lines:
        return cells
    nothing = np.atleast_1d(cells.empty.all(axis=0))
    first, last = 0, cells.values.shape[1]
    while last > 1 and nothing[last - 1] and (not names or len(names) < last or not names[last - 1]):
        last -= 1
    while not names and last - first > 1 and nothing[first]:
        first += 1
    if (first, last) == (0, cells.values.shape[1]):
        return cells
    kept = slice(first, last)
    if len(names) > last:
        del names[last:]
    return cells._replace(values=cells.values[:, kept], text=cells.text[:, kept], empty=cells.empty[:, kept])


def _coordinates(table: _Table, columns: Sequence[str] | None, path: Path) -> tuple[int, int, int]:
    """Places of the columns of x, y and z.

    Raises:
        FileFormatError: There are fewer than three columns, or names that do not tell.
        InputError: A name in ``columns`` is none of the file's.
    """
    names, cells = table.names, table.cells
    listed = in_one_line(", ".join(map(repr, names)))
    if columns is not None:
        x, y, z = _places_of(columns, names, path)
        return x, y, z
    if table.named:
        found = coordinate_columns(names, path)
        if found is not None:
            return found
    if table.named == "header" and not len(cells.values):
        raise FileFormatError(f"{path}: has a header ({listed}) and no rows; get a whole copy")
    width = len(names) if names else 3
    _take_first(table, "points", AXES, path)
    if not cells.lines:
        return 0, 1, 2
    labels = np.atleast_1d(cells.text.any(axis=0) & (cells.text | cells.empty).all(axis=0))
    first = next((at for at in range(width - 2) if not labels[at : at + 3].any()), None)
    if first is None or not labels[:first].all():
        raise not_numbers(cells, int(np.argmax(cells.text.any(axis=1))), path)
    return first, first + 1, first + 2


def _take_first(table: _Table, what: str, needed: Sequence[str], path: Path) -> None:
    """Refuse a table that has too few columns, or whose header does not name them; of words in a comment it is said.

    Raises:
        FileFormatError: The columns cannot be the first ones.
    """
    names, count, usual = table.names, len(needed), ", ".join(needed)
    listed = in_one_line(", ".join(map(repr, names)))
    if names and len(names) < count:
        raise FileFormatError(f"{path}: has {len(names)} columns; {what} need {usual}")
    if table.named == "header":
        raise FileFormatError(
            f"{path}: its columns are not named as those of {what}, {usual}: {listed}; choose {count} with "
            f"columns=({', '.join(map(repr, names[:count]))})"
        )
    if table.named == "comment" and len(names) > count:
        warn(
            f"{path}: the words of its comment ({listed}) are no names of {what}; the first {count} columns are taken "
            f"as {usual}, and columns=(...) chooses others"
        )


def _places_of(columns: Sequence[str], names: list[str], path: Path) -> list[int]:
    """Places of chosen columns.

    Raises:
        InputError: A name is none of the file's, or of several columns.
    """
    times = Counter(names)
    missing = [name for name in columns if times[name] != 1]
    if missing:
        listed = in_one_line(", ".join(map(repr, names)))
        raise InputError(f"columns: {missing[0]!r} is not the name of one column of {path}; its columns are {listed}")
    return [names.index(name) for name in columns]


def _named_columns(table: _Table, places: tuple[int, int, int], path: Path) -> Columns:
    """The coordinates as x, y and z, and the other columns by name, without those of text.

    Raises:
        FileFormatError: Two columns have the same name, or a column holds words beside numbers.
    """
    names, cells = table.names, table.cells
    others = [at for at in range(len(names)) if at not in places]
    times = Counter(names)
    repeated = [names[at] for at in others if times[names[at]] > 1]
    if repeated:
        raise FileFormatError(f"{path}: two columns are called {repeated[0]!r}; give each its own name")
    if not len(cells.values):
        nothing = np.empty(0)
        return {**dict.fromkeys(AXES, nothing), **{names[at]: nothing for at in others}}
    cells.refuse(places, path)
    columns: Columns = {axis: cells.values[:, at] for axis, at in zip(AXES, places, strict=True)}
    text = np.atleast_1d(cells.text.any(axis=0)) if cells.lines else np.zeros(len(names), bool)
    worded = text & np.atleast_1d((cells.text | cells.empty).all(axis=0)) if cells.lines else text
    labels = [at for at in others if worded[at]]
    mixed = [at for at in others if text[at] and not worded[at]]
    if mixed:
        raise not_numbers(cells, int(np.argmax(cells.text[:, mixed].any(axis=1))), path)
    if labels:
        shown = in_one_line(", ".join(repr(names[at]) for at in labels))
        warn(f"{path}: columns of text are left out: {shown}")
    for at in others:
        if not worded[at]:
            # Columns that are not chosen may have the names of those that are.
            columns[f"{names[at]}_" if names[at] in AXES else names[at]] = cells.values[:, at]
    return columns


# Excel's first line, which names what separates the cells below it.
_SEPARATOR = re.compile(r'"?sep=."?', re.IGNORECASE)
# Words of a line of names; a unit in brackets belongs to the word before it.
_WORD = re.compile(r'"[^"]*"|[^\s\[(]+(?:[ ]*[\[(][^\])]*[\])])?|\S+')


def _words(line: str) -> list[str]:
    separator = separator_of(line)
    if separator is None and "\t" in line.strip():
        separator = "\t"
    return split_line(line, separator) if separator else [word.strip().strip('"') for word in _WORD.findall(line)]
