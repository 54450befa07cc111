"""Records in files, and the one sort of them into boxes: a file for each, of what need not fit into memory."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.private_folder import private_folder
from geokit.errors import FileAccessError

# Records that are read at a time, and memory for what is read, sorted and written then.
AT_A_TIME, BYTES_AT_A_TIME = 1 << 17, 64 << 20
# Largest block: it is held several times while it is converted.
BLOCK_BYTES = 12 << 20


@contextlib.contextmanager
def work_folder(place: Path) -> Iterator[Path]:
    """Provide a private folder in ``place``, for files that nobody keeps.

    Raises:
        FileAccessError: It cannot be written.
    """
    try:
        with private_folder(place) as folder:
            yield folder
    except OSError as error:
        if isinstance(error, FileAccessError):
            raise
        raise FileAccessError(
            f"{place}: cannot write there ({error.strerror or error}); name another folder"
        ) from error


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
    data: dict[str, NDArray[Any]]


def survey(blocks: Iterable[tuple[NDArray[Any], Mapping[str, NDArray[Any]]]], step: int) -> Known:
    """Look at all points; the first block tells the arrays, and one in ``step`` points is in the sample."""
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    count, sample, arrays = 0, [np.zeros((0, 3))], None
    for points, data in blocks:
        if arrays is None:
            arrays = {name: values[:0] for name, values in data.items()}
        if len(points):
            sample.append(points[-count % step :: step].astype(np.float64))
            # Column by column: the whole table at once takes ten times as long.
            lower = np.minimum(lower, [column.min() for column in points.T])
            upper = np.maximum(upper, [column.max() for column in points.T])
            count += len(points)
    if not count:
        lower, upper = np.zeros(3), np.zeros(3)
    return Known(count, lower, upper, np.concatenate(sample), arrays or {})


def rows_at_a_time(rows: int, width: int) -> int:
    """So many rows, or fewer if they are wide."""
    return max(1, min(rows, BLOCK_BYTES // max(width, 1)))


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

    def take(self) -> NDArray[Any]:
        """All records; the file is removed."""
        records = self.read()
        self.path.unlink(missing_ok=True)
        return records

    @property
    def rows(self) -> int:
        """Records that are read at a time."""
        return rows_at_a_time(AT_A_TIME, self.dtype.itemsize)

    def parts(self, rows: int | None = None) -> Iterator[NDArray[Any]]:
        """The records, some at a time."""
        rows = self.rows if rows is None else rows
        for first in range(0, self.count, rows):
            yield self.read(first, min(rows, self.count - first))


class Buckets:
    """Records that are sorted into a file for each box, which has them in the order in which they came.

    Args:
        stem: Path of the files, without the number of the box.
        dtype: Type of the records.
        count: Number of boxes.
    """

    def __init__(self, stem: Path, dtype: np.dtype[Any], count: int) -> None:
        self._stem, self._dtype, self._counts = stem, dtype, [0] * count

    def add(
        self, records: NDArray[Any], box: NDArray[np.int64], row: NDArray[np.int64] | None = None
    ) -> list[tuple[int, NDArray[np.int64]]]:
        """Sort more records; returns boxes that have some of them, and their rows.

        Args:
            records: Some records.
            box: Box of each record, (N,), or of each pair of a record and one of its boxes, for a halo, (P,).
            row: Row of the record of each pair, (P,).
        """
        order = np.argsort(box, kind="stable")
        row, box = order if row is None else row[order], box[order]
        starts = np.flatnonzero(np.diff(box, prepend=-1))
        added = list(zip(box[starts].tolist(), np.split(row, starts)[1:], strict=True))
        for at, some in added:
            append(self.file(at).path, records[some])
            self._counts[at] += len(some)
        return added

    def file(self, at: int) -> RecordFile:
        """The file of a box."""
        return RecordFile(self._stem.with_name(f"{self._stem.name}-{at}"), self._dtype, self._counts[at])

    def files(self) -> list[tuple[int, RecordFile]]:
        """Boxes with records, and their files."""
        return [(at, self.file(at)) for at, count in enumerate(self._counts) if count]
