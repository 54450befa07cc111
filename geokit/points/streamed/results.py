"""Results of points that come tile by tile, put back into the order of the points, on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.blocks.records import Buckets
from geokit.formats.columns import Columns

__all__ = ["Results"]


class Results:
    """Arrays of points by row.

    Args:
        dtype: Type of the records: "row", and a field for each array.
        folder: Where the files are made.
        memory: Bytes that may be taken.
        count: Number of points.
    """

    def __init__(self, dtype: np.dtype[Any], folder: Path, memory: int, count: int) -> None:
        self._dtype = dtype
        # The rows of a file, twice while they are put in order.
        self._rows = max(memory // (2 * dtype.itemsize), 1)
        self._buckets = Buckets(folder / "results", dtype, -(-count // self._rows))
        self._held, self._first = np.empty(0, dtype), 0

    def add(self, records: NDArray[Any]) -> None:
        """Keep arrays of some points."""
        self._buckets.add(records, records["row"] // self._rows)

    def take(self, count: int) -> Columns:
        """The arrays of the next points."""
        found = []
        while count:
            if not len(self._held):
                self._held = self._next()
            found.append(self._held[:count])
            self._held = self._held[count:]
            count -= len(found[-1])
        whole = np.concatenate([np.empty(0, self._dtype), *found])
        return {name: whole[name] for name in self._dtype.names or () if name != "row"}

    def _next(self) -> NDArray[np.void]:
        records = self._buckets.file(self._first // self._rows).take()
        whole = np.empty_like(records)
        whole[records["row"] - self._first] = records
        self._first += len(records)
        return whole
