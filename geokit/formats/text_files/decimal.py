"""Large tables of plain decimal numbers, read and written in C++ on all threads; slower readers handle all else."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

_T = TypeVar("_T")

# NumPy reads shorter text in milliseconds, as fast as the parser.
SMALLEST = 1 << 14
# Bytes of text for a thread at a time: thousands of lines, and hundreds of chunks in a file that takes long.
CHUNK = 1 << 18
# Bits of a NaN in which the parser stores the position of a number's text, plus one.
PLACE = np.uint64((1 << 51) - 1)
_WORD = re.compile(rb"[^\s,;]+")
# Rows that a thread writes at a time.
ROWS = 1 << 13
# What stands for a number in a pattern of the extension, and the type of its 64 bits; characters of the longest.
_PLACES = {"f": ("\0", np.float64), "i": ("\1", np.int64), "b": ("\1", np.int64), "u": ("\2", np.uint64)}
_LONGEST = 24


def plain_rows(data: bytes, start: int, stop: int) -> NDArray[np.float64] | None:
    """Rows of numbers in ``data[start:stop]``, each rounded correctly; None if the text is small or not plain.

    Plain text has decimal numbers and ``nan``, equally many in each line, separated by commas, semicolons or white
    space. A comment, another word or an incomplete line anywhere makes it not plain. The result is also None if geokit
    was built without a compiler.
    """
    if stop - start < SMALLEST:
        return None
    return parse(data, start, stop)


def parse(data: bytes, start: int, stop: int, chunk: int = CHUNK) -> NDArray[np.float64] | None:
    """Parse text of any size as :func:`plain_rows` does, in chunks of so many bytes."""
    from geokit.native.parsers.extension import parsers

    core = parsers()
    shape = None if core is None else _shape_of_first(data, start, stop)
    if core is None or shape is None:
        return None
    columns, separator = shape
    firsts = range(start, stop, chunk)
    rows = _in_threads(lambda at: core.count_rows(data, start, stop, firsts[at], firsts[at] + chunk), len(firsts))
    ends = np.cumsum(rows) * columns
    table = np.empty(ends[-1])
    begins = ends - np.array(rows) * columns

    def fill(at: int) -> bool:
        part = table[begins[at] : ends[at]]
        return bool(core.parse_rows(data, start, stop, firsts[at], firsts[at] + chunk, columns, separator, part))

    if not all(_in_threads(fill, len(firsts))):
        return None
    _read_again(table, data)
    return table.reshape(-1, columns)


def _in_threads(work: Callable[[int], _T], count: int) -> list[_T]:
    """Results of ``work(0) .. work(count - 1)``, computed in threads if there are several."""
    from geokit.core import launcher

    if min(launcher.thread_count(), count) == 1:
        return [work(at) for at in range(count)]
    return launcher.pool().map(work, range(count))


def written_rows(pattern: str, *tables: NDArray[Any]) -> list[bytes]:
    """Parts of ASCII text: ``pattern`` for each row of the tables side by side, with its next number for each ``{}``.

    A float has the fewest digits that read back as the same float64, as Python writes it. The tables are of shapes (N,)
    or (N, K), floats or whole numbers; True is 1.
    """
    from geokit.native.parsers.extension import parsers

    core = parsers()
    columns = [column for table in tables for column in (table.T if table.ndim > 1 else [table])]
    marks, kinds = zip(*(_PLACES[column.dtype.kind] for column in columns), strict=True)
    marked = pattern.format(*marks).encode("ascii")

    def part(at: int) -> bytes:
        some = [column[at * ROWS : (at + 1) * ROWS] for column in columns]
        if core is None:
            rows = zip(*(column.astype(kind).tolist() for column, kind in zip(some, kinds, strict=True)), strict=True)
            return "".join(pattern.format(*row) for row in rows).encode("ascii")
        table = np.empty((len(some[0]), len(some)), np.uint64)
        for out, column, kind in zip(table.T, some, kinds, strict=True):
            out.view(kind)[:] = column
        text = np.empty(len(table) * (len(marked) + _LONGEST * len(some)), np.uint8)
        return text[: core.write_rows(table, marked, text)].tobytes()

    return _in_threads(part, -(-len(columns[0]) // ROWS))


def written_lines(*tables: NDArray[Any], prefix: str = "", separator: str = " ") -> list[bytes]:
    """Lines of the numbers of each row, as :func:`written_rows` has them."""
    count = sum(table.shape[1] if table.ndim > 1 else 1 for table in tables)
    return written_rows(prefix + separator.join(["{}"] * count) + "\n", *tables)


def _shape_of_first(data: bytes, start: int, stop: int) -> tuple[int, int] | None:
    """Count of the numbers in the first line, and the character code of their separator, 0 for white space."""
    at = start
    while at < stop:
        end = data.find(b"\n", at, stop)
        end = stop if end < 0 else end
        line = data[at:end].strip()
        if line:
            separator = next((sign for sign in b",;" if sign in line), 0)
            words = line.split(bytes([separator])) if separator else line.split()
            return len(words), separator
        at = end + 1
    return None


def _read_again(table: NDArray[np.float64], data: bytes) -> None:
    """Read numbers beyond float64's range, which the parser leaves to Python: infinity, zero or a subnormal number."""
    rows = np.flatnonzero(np.isnan(table))
    places = (table[rows].view(np.uint64) & PLACE).astype(np.int64) - 1
    for row, place in zip(rows[places >= 0], places[places >= 0].tolist(), strict=True):
        word = _WORD.match(data, place)
        table[row] = float(word.group()) if word else np.nan
