"""Tiles: boxes of points in files, with arrays, as records; points around a box, read from the files of several."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.blocks.boxes import Boxes
from geokit.formats.blocks.points import Block
from geokit.formats.blocks.records import Buckets, Known, RecordFile, append, survey
from geokit.formats.columns import Columns

# A point in a tile: its row among all points.
ROW = np.dtype([("row", np.int64), ("points", np.float64, (3,))])
# Points that are in memory at most: kernels count them in 32 bits, and more would not be faster.
MOST_POINTS = 1 << 27
# Share of the points in memory that are a tile's own; the others may lie around it.
OWN_SHARE = 0.5
# Points of a bin, which is read as a whole, about; most bins of all tiles, whose boxes stay in memory (56 bytes each);
# and points of a sample that divides a tile into bins.
BIN_POINTS, MOST_BINS, BIN_SAMPLE = 512, 1 << 18, 1 << 13
# Tiles that are made at once.
MOST_PARTS = 1024
# Points that stand for all where these are divided: 64 for each of 2000 parts, whose sizes then scatter by an eighth.
SAMPLE_SIZE = 1 << 17


@dataclass(frozen=True)
class _Tile:
    """Points of a box, sorted by bin: smaller boxes.

    Attributes:
        file: The points; in a bin they have the order of their rows.
        begin: Number of the points before each bin, and of all at the end; shape (B + 1,).
        lower: Least coordinates of the points of each bin, (B, 3).
        upper: Largest ones.
    """

    file: RecordFile
    begin: NDArray[np.int64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]


class Tiles:
    """All points, sorted into tiles.

    Args:
        blocks: The points, some at a time.
        known: What is known of them.
        most: Number of points that a tile may have.
        folder: Where the files are made.
    """

    def __init__(self, blocks: Iterable[Block], known: Known, most: int, folder: Path) -> None:
        self.known, self._folder, self._most = known, folder, most
        self._tiles: list[_Tile] = []

        def numbered() -> Iterable[NDArray[Any]]:
            first = 0
            for points, _ in blocks:
                records = np.empty(len(points), ROW)
                records["row"], records["points"] = np.arange(first, first + len(points)), points
                first += len(points)
                yield records

        self._divide(numbered(), known.count, known.sample, "tile")
        boxes = [(tile.lower.min(axis=0), tile.upper.max(axis=0)) for tile in self._tiles]
        self._lower, self._upper = np.array(boxes).reshape(-1, 2, 3).transpose(1, 0, 2)

    def __len__(self) -> int:
        return len(self._tiles)

    def own(self, number: int) -> NDArray[Any]:
        """All points of a tile, by row."""
        records = self._tiles[number].file.read()
        return records[np.argsort(records["row"])]

    def around(self, lower: NDArray[np.float64], upper: NDArray[np.float64], most: int) -> NDArray[Any] | None:
        """The points of a box, corners included, by row; None if they are more than ``most``."""
        found, count = [np.empty(0, ROW)], 0
        for number in np.flatnonzero(((self._lower <= upper) & (self._upper >= lower)).all(axis=1)).tolist():
            tile = self._tiles[number]
            bins = np.flatnonzero(((tile.lower <= upper) & (tile.upper >= lower)).all(axis=1))
            # Bins that follow each other are read at once.
            for run in np.split(bins, np.flatnonzero(np.diff(bins) > 1) + 1) if len(bins) else ():
                first, last = int(tile.begin[run[0]]), int(tile.begin[run[-1] + 1])
                records = tile.file.read(first, last - first)
                inside = np.ones(len(records), bool)
                for axis in range(3):
                    along = records["points"][:, axis]
                    inside &= (along >= lower[axis]) & (along <= upper[axis])
                found.append(records[inside])
                count += len(found[-1])
                if count > most:
                    return None
        whole = np.concatenate(found)
        del found
        return whole[np.argsort(whole["row"])]

    def nearest(self, point: NDArray[np.float64], count: int) -> NDArray[Any]:
        """The points nearest to a position, by row; ties go to the lowest row."""
        kept, squared = np.empty(0, ROW), np.empty(0)
        gap = _gaps(point, self._lower, self._upper)
        for number in np.argsort(gap, kind="stable").tolist():
            if len(kept) == count and gap[number] > squared.max():
                break
            tile = self._tiles[number]
            inner = _gaps(point, tile.lower, tile.upper)
            for at in np.argsort(inner, kind="stable").tolist():
                if len(kept) == count and inner[at] > squared.max():
                    break
                first, last = int(tile.begin[at]), int(tile.begin[at + 1])
                kept = np.concatenate([kept, tile.file.read(first, last - first)])
                d = kept["points"] - point
                squared = (d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1]) + d[:, 2] * d[:, 2]
                order = np.lexsort([kept["row"], squared])[:count]
                kept, squared = kept[order], squared[order]
        return kept[np.argsort(kept["row"])]

    def _divide(self, parts: Iterable[NDArray[Any]], count: int, sample: NDArray[np.float64], stem: str) -> None:
        """Sort points into files of boxes, and these again where they have too many points."""
        if not count:
            return
        boxes = Boxes(sample, min(-(-2 * count // self._most), MOST_PARTS))
        buckets = Buckets(self._folder / stem, ROW, boxes.count)
        for records in parts:
            buckets.add(records, boxes.of(records["points"]))
        for _, file in buckets.files():
            if file.count <= self._most:
                self._tiles.append(self._binned(file))
                continue
            some = sample_of(file, BIN_SAMPLE)
            if (some == some[0]).all():
                self._slice(file)
                continue
            self._divide(file.parts(), file.count, some, file.path.name)
            os.unlink(file.path)

    def _slice(self, file: RecordFile) -> None:
        """Make tiles of consecutive rows: of points that a sample finds in one place."""
        for at, records in enumerate(file.parts(self._most)):
            path = file.path.with_name(f"{file.path.name}-{at}")
            append(path, records)
            self._tiles.append(self._binned(RecordFile(path, ROW, len(records))))
        os.unlink(file.path)

    def _binned(self, file: RecordFile) -> _Tile:
        """Sort the points of a tile by bin."""
        records = file.read()
        wanted = -(-len(records) // max(BIN_POINTS, self.known.count // MOST_BINS))
        boxes = Boxes(records["points"][:: max(1, len(records) // BIN_SAMPLE)], wanted)
        box = boxes.of(records["points"])
        records = records[np.argsort(box, kind="stable")]
        with open(file.path, "wb") as out:
            out.write(records.data)
        sizes = np.bincount(box, minlength=boxes.count)
        sizes = sizes[sizes > 0]
        begin = np.concatenate([[0], np.cumsum(sizes)])
        points = np.ascontiguousarray(records["points"])
        lower, upper = (function.reduceat(points, begin[:-1], axis=0) for function in (np.minimum, np.maximum))
        return _Tile(file, begin, lower, upper)


def _gaps(point: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared distances of boxes from a point, a few roundings short of those of the points in them."""
    aside = np.maximum(np.maximum(lower - point, point - upper), 0.0)
    return (aside * aside).sum(axis=1) * (1.0 - 1e-14)


def known_of(blocks: Iterable[Block], declared: int) -> Known:
    """Look at all points, of which there are about as many as declared."""
    return survey(blocks, max(1, declared // SAMPLE_SIZE))


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


def sample_of(file: RecordFile, most: int) -> NDArray[np.float64]:
    """Positions of some records, evenly spaced."""
    return survey(((part["points"], {}) for part in file.parts()), max(1, file.count // most)).sample


def blocks_of(file: RecordFile) -> Iterator[Block]:
    """The points and their arrays; the first block has none."""
    names = [name for name in file.dtype.names or () if name.startswith("data ")]
    for part in chain([np.empty(0, file.dtype)], file.parts()):
        yield part["points"], {name[len("data ") :]: part[name] for name in names}
