"""Results of points that come tile by tile, put back into the order of the points, on disk."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.columns import Columns
from geokit.points.streamed.records import append

__all__ = ["Results"]


class Results:
    """Arrays of points by row.

    Args:
        data: The arrays without rows.
        folder: Where the files are made.
        memory: Bytes that may be taken.
    """

    def __init__(self, data: Columns, folder: Path, memory: int) -> None:
        self._names = list(data)
        fields = [(name, values.dtype, values.shape[1:]) for name, values in data.items()]
        self._dtype = np.dtype([("row", np.int64), *fields])
        self._folder = folder
        # The rows of a file, twice while they are put in order.
        self._rows = max(memory // (2 * self._dtype.itemsize), 1)
        self._held, self._first = np.empty(0, self._dtype), 0

    def add(self, records: NDArray[Any]) -> None:
        """Keep arrays of some points, ascending by row."""
        files = records["row"] // self._rows
        for number in np.unique(files).tolist():
            first, last = np.searchsorted(files, [number, number + 1])
            append(self._path(number), records[first:last])

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
        return {name: whole[name] for name in self._names}

    def _next(self) -> NDArray[np.void]:
        path = self._path(self._first // self._rows)
        records = np.fromfile(path, self._dtype)
        os.unlink(path)
        whole = np.empty_like(records)
        whole[records["row"] - self._first] = records
        self._first += len(records)
        return whole

    def _path(self, number: int) -> Path:
        return self._folder / f"results-{number}"
