"""Large tables of plain decimal numbers, parsed on all threads; everything else is left to slower readers."""

from __future__ import annotations

import functools
import re

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.host_array import HostArray

__all__ = ["SMALLEST", "parse", "plain_rows"]

# Below this the kernels cost more to load than they save: NumPy reads it in a tenth of a second.
SMALLEST = 1 << 20
# Bytes of text for a thread at a time: thousands of lines, and hundreds of chunks in a file that takes long.
CHUNK = 1 << 18
# Powers of ten that float64 numbers of up to 19 digits may have.
LOWEST, HIGHEST = -342, 308
# The bits of a NaN in which the kernel says where the text of a number stands, plus one.
PLACE = np.uint64((1 << 51) - 1)
_WORD = re.compile(rb"[^\s,;]+")


def plain_rows(data: bytes, start: int, stop: int) -> NDArray[np.float64] | None:
    """Rows of numbers in ``data[start:stop]``, each rounded correctly; None where it is small or out of the ordinary.

    Ordinary are decimal numbers and ``nan``, as many in each line, between commas, semicolons or white space; a
    comment, another word or an incomplete line anywhere is not. tests/formats/test_decimal_property.py holds the
    numbers against Python's.
    """
    if stop - start < SMALLEST:
        return None
    return parse(data, start, stop)


def parse(data: bytes, start: int, stop: int, chunk: int = CHUNK) -> NDArray[np.float64] | None:
    """:func:`plain_rows` for text of any size, in chunks of so many bytes."""
    from geokit.formats.decimal_kernels import count_kernel, parse_kernel

    shape = _shape_of_first(data, start, stop)
    if shape is None:
        return None
    columns, separator = shape
    device = launcher.resolve_device("cpu")
    text = HostArray(np.frombuffer(data, np.uint8))
    chunks = -(-(stop - start) // chunk)
    rows = np.zeros(chunks, np.int64)
    shared = [text, start, stop, chunk]
    launcher.launch(count_kernel, chunks, shared, [HostArray(rows)], device, grain=1)
    table = np.empty(int(rows.sum()) * columns)
    odd = np.zeros(chunks, np.int32)
    above = HostArray(np.cumsum(rows) - rows)
    powers, exponents = _powers()
    inputs = [*shared, above, columns, separator, HostArray(powers), HostArray(exponents)]
    launcher.launch(parse_kernel, chunks, inputs, [HostArray(table), HostArray(odd)], device, grain=1)
    if odd.any():
        return None
    _read_again(table, data)
    return table.reshape(-1, columns)


def _shape_of_first(data: bytes, start: int, stop: int) -> tuple[int, int] | None:
    """How many numbers the first line has and the code of what is between them, 0 for white space."""
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
    """What the kernel could not round: exact ties, denormal numbers and the like, one by one."""
    rows = np.flatnonzero(np.isnan(table))
    places = (table[rows].view(np.uint64) & PLACE).astype(np.int64) - 1
    for row, place in zip(rows[places >= 0], places[places >= 0].tolist(), strict=True):
        word = _WORD.match(data, place)
        table[row] = float(word.group()) if word else np.nan


@functools.lru_cache(maxsize=1)
def _powers() -> tuple[NDArray[np.uint64], NDArray[np.int32]]:
    """The leading 128 bits of each power of ten, high and low word, and the binary exponent that they lack."""
    words, exponents = [], []
    for power in range(LOWEST, HIGHEST + 1):
        if power >= 0:
            value, exponent = 10**power, 0
        else:
            exponent = -(128 + (10**-power).bit_length())
            value = (1 << -exponent) // 10**-power
        extra = value.bit_length() - 128
        value = value >> extra if extra >= 0 else value << -extra
        words += [value >> 64, value & (1 << 64) - 1]
        exponents.append(exponent + extra)
    return np.array(words, np.uint64), np.array(exponents, np.int32)
