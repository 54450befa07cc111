"""Triangles of a file, sorted into files of boxes: a box has every triangle with a corner in it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.blocks.boxes import Boxes
from geokit.formats.blocks.records import AT_A_TIME, Buckets, Known, survey
from geokit.formats.blocks.triangles import TriangleFile

__all__ = ["Tiles", "survey_triangles"]

# Triangles that stand for all where these are divided.
SAMPLE_SIZE = 1 << 16


def survey_triangles(source: TriangleFile) -> Known:
    """What one pass over the corners of all triangles tells; the sample has first corners."""
    none: dict[str, NDArray[Any]] = {}
    corners = ((block.reshape(-1, 3), none) for block in source.blocks(AT_A_TIME))
    return survey(corners, 3 * max(1, source.count // SAMPLE_SIZE))


class Tiles:
    """The files of the boxes.

    Args:
        boxes: Where corners belong.
        folder: Where the files are made.
        dtype: Type of the coordinates.
    """

    def __init__(self, boxes: Boxes, folder: Path, dtype: np.dtype[Any]) -> None:
        self._boxes = boxes
        # A triangle in several files has a number there, else -1.
        self._record = np.dtype([("corners", dtype, (3, 3)), ("shared", np.int64)])
        self._buckets = Buckets(folder / "tile", self._record, boxes.count)
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
            self._buckets.add(records, box[row, column], row)
            yield len(block)

    def take(self, box: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Corners (N, 3, 3) of a box's triangles, and the numbers of shared ones (N,); its file is removed."""
        records = self._buckets.file(box).take()
        return records["corners"].astype(np.float64), records["shared"].copy()
