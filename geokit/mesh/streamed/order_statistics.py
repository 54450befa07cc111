"""Order statistics of numbers in a file, without sorting them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

__all__ = ["OrderStatistics"]

# Bits of a number that one pass decides, and numbers that are read at a time.
BITS, AT_A_TIME = 16, 1 << 20


class OrderStatistics:
    """Numbers from 0 to infinity, in a file that grows.

    The bits of such numbers, taken as integers, have their order. Each of four passes counts 16 more bits of those that
    begin like the number which is looked for.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._count = path, 0

    def add(self, numbers: NDArray[np.float64]) -> None:
        """Add numbers, none of them negative or NaN."""
        with open(self._path, "ab") as file:
            file.write(np.ascontiguousarray(numbers).data)
        self._count += len(numbers)

    def at(self, ranks: Sequence[int]) -> NDArray[np.float64]:
        """The numbers at some ranks, counted from 0."""
        found, left = np.zeros(len(ranks), np.uint64), list(ranks)
        for shift in range(64 - BITS, -1, -BITS):
            # Ranks that begin alike share a count.
            prefixes = sorted({int(number) >> (shift + BITS) for number in found})
            counts = {prefix: np.zeros(1 << BITS, np.int64) for prefix in prefixes}
            for first in range(0, self._count, AT_A_TIME):
                bits = np.fromfile(self._path, np.uint64, AT_A_TIME, offset=8 * first)
                next_bits = (bits >> np.uint64(shift)) & np.uint64((1 << BITS) - 1)
                for prefix, count in counts.items():
                    begun = next_bits if shift + BITS == 64 else next_bits[bits >> np.uint64(shift + BITS) == prefix]
                    count += np.bincount(begun.astype(np.int64), minlength=1 << BITS)
            for k, rank in enumerate(left):
                ends = np.cumsum(counts[int(found[k]) >> (shift + BITS)])
                digit = int(np.searchsorted(ends, rank, side="right"))
                left[k] = rank - (int(ends[digit - 1]) if digit else 0)
                found[k] |= np.uint64(digit << shift)
        return found.view(np.float64)
