"""Records of points in files beside the target, and what one pass over points tells of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.blocks.points import rows_at_a_time
from geokit.formats.columns import Columns

__all__ = ["AT_A_TIME", "BYTES_AT_A_TIME", "Block", "Known", "RecordFile", "append", "records_of", "survey", "type_of"]

# Points that are read at a time, and memory for what is read, sorted and written then.
AT_A_TIME, BYTES_AT_A_TIME = 1 << 17, 64 << 20
# Points that stand for all where these are divided: 64 for each of 2000 parts, whose sizes then scatter by an eighth.
SAMPLE_SIZE = 1 << 17

Block = tuple[NDArray[np.float64], Columns]


@dataclass(frozen=True)
class Known:
    """What one pass over points tells.

    Attributes:
        count: Their number.
        lower: Least coordinates [world], (3,); zeros if there are no points.
        upper: Largest coordinates [world], (3,).
        sample: Some of the points, evenly spaced in their order, (S, 3) [world].
        data: Their arrays without rows.
    """

    count: int
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    sample: NDArray[np.float64]
    data: Columns


def survey(blocks: Iterable[Block], declared: int) -> Known:
    """Look at all points; the first block tells the arrays.

    Args:
        blocks: The points.
        declared: Number of points, about.
    """
    step = max(1, declared // SAMPLE_SIZE)
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    count, sample, arrays = 0, [np.zeros((0, 3))], None
    for points, data in blocks:
        if arrays is None:
            arrays = {name: values[:0] for name, values in data.items()}
        if len(points):
            sample.append(points[-count % step :: step].copy())
            lower, upper = np.minimum(lower, points.min(axis=0)), np.maximum(upper, points.max(axis=0))
            count += len(points)
    if not count:
        lower, upper = np.zeros(3), np.zeros(3)
    return Known(count, lower, upper, np.concatenate(sample), arrays or {})


def type_of(data: Columns) -> np.dtype[Any]:
    """The type of records with a position, ``points``, and arrays."""
    # A name of an array may be anything.
    arrays = [(f"data {name}", values.dtype, values.shape[1:]) for name, values in data.items()]
    return np.dtype([("points", np.float64, (3,)), *arrays])


def records_of(points: NDArray[np.float64], data: Columns) -> NDArray[Any]:
    """Points with arrays as records."""
    records = np.empty(len(points), type_of(data))
    records["points"] = points
    for name, values in data.items():
        records[f"data {name}"] = values
    return records


def append(path: Path, records: NDArray[Any]) -> None:
    """Add records to the end of a file. It is closed again, because a process may open few files at a time."""
    with open(path, "ab") as file:
        file.write(np.ascontiguousarray(records).data)


@dataclass(frozen=True)
class RecordFile:
    """Records of one type in a file, which is there if there are any."""

    path: Path
    dtype: np.dtype[Any]
    count: int

    def read(self, first: int = 0, rows: int | None = None) -> NDArray[Any]:
        """Some records, or all from the first one on."""
        rows = self.count - first if rows is None else rows
        if rows <= 0:
            return np.empty(0, self.dtype)
        return np.fromfile(self.path, self.dtype, rows, offset=first * self.dtype.itemsize)

    @property
    def rows(self) -> int:
        """Records that are read at a time."""
        return rows_at_a_time(AT_A_TIME, self.dtype.itemsize)

    def parts(self, rows: int | None = None) -> Iterator[NDArray[Any]]:
        """The records, some at a time."""
        rows = self.rows if rows is None else rows
        for first in range(0, self.count, rows):
            yield self.read(first, min(rows, self.count - first))

    def sample(self, most: int) -> NDArray[np.float64]:
        """Positions of some records, evenly spaced."""
        step = max(1, self.count // most)
        found = [np.zeros((0, 3))]
        for at, part in enumerate(self.parts()):
            found.append(part["points"][-(at * self.rows) % step :: step].copy())
        return np.concatenate(found)

    def blocks(self) -> Iterator[Block]:
        """The points and their arrays; the first block has none."""
        names = [name for name in self.dtype.names or () if name.startswith("data ")]
        for part in chain([np.empty(0, self.dtype)], self.parts()):
            yield part["points"], {name[len("data ") :]: part[name] for name in names}
