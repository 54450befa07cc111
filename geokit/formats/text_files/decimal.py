"""Fast parsing of large tables of plain decimal numbers, in C++ on all threads; slower readers handle all else."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = ["SMALLEST", "parse", "plain_rows"]

# NumPy reads shorter text in milliseconds, as fast as the parser.
SMALLEST = 1 << 14
# Bytes of text for a thread at a time: thousands of lines, and hundreds of chunks in a file that takes long.
CHUNK = 1 << 18
# Bits of a NaN in which the parser stores the position of a number's text, plus one.
PLACE = np.uint64((1 << 51) - 1)
_WORD = re.compile(rb"[^\s,;]+")


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


def _in_threads(work: Callable[[int], int], count: int) -> list[int]:
    """Results of ``work(0) .. work(count - 1)``, computed in threads if there are several."""
    from geokit.core import launcher

    if min(launcher.thread_count(), count) == 1:
        return [work(at) for at in range(count)]
    return launcher.pool().map(work, range(count))


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
