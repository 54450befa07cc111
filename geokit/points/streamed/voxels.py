"""Centroids of the points in each voxel, for points in files: parts of whole voxels, one after the other."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.blocks.points import Block
from geokit.formats.blocks.records import Buckets, Known, RecordFile, append
from geokit.points._downsample import downsample
from geokit.points.clouds.voxel_centroids import require_resolved
from geokit.points.clouds.voxel_centroids_kernels import PIECE
from geokit.points.streamed.records import records_of, sample_of, type_of
from geokit.points.streamed.tiles import MOST_POINTS

if TYPE_CHECKING:
    import warp as wp

__all__ = ["Voxels"]

# Parts that points are divided into at a time, and points of a sample for each.
MOST_PARTS, PART_SAMPLE = 512, 256


class Voxels:
    """Downsamples by voxels.

    Args:
        voxel_size: Edge length of a voxel [world].
        memory: Bytes that may be taken.
        folder: Where the files are made.
        device: Where to compute.
        report: Called with the part of the points that is done, from 0 to 1.
    """

    def __init__(
        self, voxel_size: float, memory: int, folder: Path, device: "wp.Device", report: Callable[[float], None]
    ) -> None:
        self._size, self._memory, self._folder, self._device = voxel_size, memory, folder, device
        self._report, self._done, self._total = report, 0, 1

    def of(self, blocks: Iterable[Block], known: Known) -> RecordFile:
        """Centroids of the voxels in ascending (z, y, x), with the arrays of the point nearest to each.

        Raises:
            InputError: The voxels are too small for coordinates of this size.
        """
        require_resolved(known.lower, known.upper, self._size)
        self._dtype, self._total = type_of(known.data), max(known.count, 1)
        # The records twice, and what downsample needs.
        self._most = min(self._memory // (2 * self._dtype.itemsize + 130), MOST_POINTS)
        self._target, self._count = self._folder / "centroids", 0
        records = (records_of(points, data) for points, data in blocks)
        self._divide(records, known.count, known.sample, known.lower, known.upper, "voxels")
        return RecordFile(self._target, self._dtype, self._count)

    def _divide(
        self,
        parts: Iterable[NDArray[Any]],
        count: int,
        sample: NDArray[np.float64],
        lower: NDArray[np.float64],
        upper: NDArray[np.float64],
        stem: str,
    ) -> None:
        """Sort points into files of layers of voxels, and handle these in ascending order."""
        if not count:
            return
        low, high = np.floor(lower / self._size), np.floor(upper / self._size)
        # Whole layers along z first, then rows, so that the parts follow each other in the order of the voxels.
        axis = next((axis for axis in (2, 1) if low[axis] < high[axis]), 0)
        layers = np.sort(np.floor(sample[:, axis] / self._size))
        wanted = min(max(2 * count // self._most, 1) + 1, MOST_PARTS)
        some = layers[np.arange(1, wanted) * len(layers) // wanted]
        # A layer of many points becomes a part of its own.
        cuts = np.unique(np.concatenate([some, some + 1.0, [low[axis] + 1.0]]))
        cuts = cuts[(cuts > low[axis]) & (cuts <= high[axis])]
        number = len(cuts) + 1
        lows, highs = np.full((number, 3), np.inf), np.full((number, 3), -np.inf)
        buckets = Buckets(self._folder / stem, self._dtype, number)
        for records in parts:
            points = records["points"]
            place = np.searchsorted(cuts, np.floor(points[:, axis] / self._size), side="right")
            for at, rows in buckets.add(records, place):
                lows[at] = np.minimum(lows[at], points[rows].min(axis=0))
                highs[at] = np.maximum(highs[at], points[rows].max(axis=0))
        for at, file in buckets.files():
            self._make(file, lows[at], highs[at])

    def _make(self, file: RecordFile, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> None:
        """Handle points of whole voxels, in their first order, in a box."""
        if file.count <= self._most:
            records = file.read()
            found = downsample(np.ascontiguousarray(records["points"]), voxel_size=self._size, device=self._device)
            kept = records[found.indices]
            kept["points"] = found.points
            self._add(kept)
        elif (np.floor(lower / self._size) == np.floor(upper / self._size)).all():
            self._add(self._centroid(file))
        else:
            some = sample_of(file, PART_SAMPLE * MOST_PARTS)
            self._divide(file.parts(), file.count, some, lower, upper, file.path.name)
            os.unlink(file.path)
            return
        os.unlink(file.path)
        self._done += file.count
        self._report(min(self._done / self._total, 1.0))

    def _add(self, kept: NDArray[Any]) -> None:
        append(self._target, kept)
        self._count += len(kept)

    def _centroid(self, file: RecordFile) -> NDArray[Any]:
        """The centroid of all points, and the arrays of the nearest one: the sums of the kernel, block after block."""
        origin = file.read(0, 1)["points"][0]
        piece = int(PIECE)
        total = np.zeros(3)
        for records in file.parts(max(file.rows // piece, 1) * piece):
            apart = records["points"] - origin
            for first in range(0, len(apart), piece):
                # Added one after the other, as in a loop.
                total += np.cumsum(apart[first : first + piece], axis=0)[-1]
        mean = total / file.count
        best, kept = np.inf, file.read(0, 1)
        for records in file.parts():
            d = (records["points"] - origin) - mean
            squared = (d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1]) + d[:, 2] * d[:, 2]
            at = int(np.argmin(squared))
            if squared[at] < best:
                best, kept = squared[at], records[at : at + 1].copy()
        kept["points"] = origin + mean
        return kept
