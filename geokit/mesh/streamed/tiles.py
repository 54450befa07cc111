"""Triangles of a file, sorted into files of boxes: a box has every triangle with a corner in it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.blocks.boxes import Boxes
from geokit.formats.blocks.triangles import TriangleFile

__all__ = ["AT_A_TIME", "Tiles", "survey"]

# Triangles that are read at a time, and triangles that stand for all where these are divided.
AT_A_TIME, SAMPLE_SIZE = 1 << 17, 1 << 16


def survey(source: TriangleFile) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The box around all triangles (2, 3), and some corners (S, 3) of triangles evenly spaced in their order."""
    step = max(1, source.count // SAMPLE_SIZE)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    count, sample = 0, []
    for corners in source.blocks(AT_A_TIME):
        sample.append(corners[-count % step :: step, 0].astype(np.float64))
        # Column by column: the whole table at once takes ten times as long.
        columns = [corners[:, :, axis] for axis in range(3)]
        low = np.minimum(low, [column.min() for column in columns])
        high = np.maximum(high, [column.max() for column in columns])
        count += len(corners)
    return np.stack([low, high]), np.concatenate(sample)


class Tiles:
    """The files of the boxes.

    Args:
        boxes: Where corners belong.
        folder: Where the files are made.
        dtype: Type of the coordinates.
    """

    def __init__(self, boxes: Boxes, folder: Path, dtype: np.dtype[Any]) -> None:
        self._boxes, self._folder = boxes, folder
        # A triangle in several files has a number there, else -1.
        self._record = np.dtype([("corners", dtype, (3, 3)), ("shared", np.int64)])
        self.shared_count = 0

    @property
    def count(self) -> int:
        """Number of boxes."""
        return self._boxes.count

    def of(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """The box of each point (N, 3)."""
        return self._boxes.of(points)

    def add(self, blocks: Iterable[NDArray[Any]]) -> Iterator[int]:
        """Sort triangles (N, 3, 3) into the files; yields how many were sorted."""
        for block in blocks:
            box = self.of(block.reshape(-1, 3).astype(np.float64)).reshape(-1, 3)
            records = np.empty(len(block), self._record)
            records["corners"], records["shared"] = block, -1
            shared = np.flatnonzero((box != box[:, :1]).any(axis=1))
            records["shared"][shared] = self.shared_count + np.arange(len(shared))
            self.shared_count += len(shared)
            # Each triangle once in each box.
            new = np.ones((len(box), 3), bool)
            new[:, 1] = box[:, 1] != box[:, 0]
            new[:, 2] = (box[:, 2] != box[:, 0]) & (box[:, 2] != box[:, 1])
            row, column = np.nonzero(new)
            target = box[row, column]
            order = np.argsort(target, kind="stable")
            row, target = row[order], target[order]
            starts = np.flatnonzero(np.diff(target, prepend=-1)).tolist()
            for first, stop in zip(starts, [*starts[1:], len(target)], strict=True):
                # Closed again each time, because a process may open few files at once.
                with open(self._path(int(target[first])), "ab") as file:
                    file.write(records[row[first:stop]].data)
            yield len(block)

    def take(self, box: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Corners (N, 3, 3) of a box's triangles, and the numbers of shared ones (N,); its file is removed."""
        path = self._path(box)
        if not path.exists():
            return np.zeros((0, 3, 3)), np.zeros(0, np.int64)
        records = np.fromfile(path, self._record)
        path.unlink()
        return records["corners"].astype(np.float64), records["shared"].copy()

    def _path(self, box: int) -> Path:
        return self._folder / f"tile{box}"
