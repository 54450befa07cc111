"""The arrays that are added to the points of a tile, here or on a worker."""

from __future__ import annotations

import functools
import pickle
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.blocks.workers import require_seen
from geokit.formats.columns import Columns
from geokit.points.streamed.columns import Density, Normals
from geokit.points.streamed.tiles import Tiles

__all__ = ["TileAnswers", "answer_on_worker"]


class TileAnswers:
    """Arrays by tile.

    Args:
        tiles: The points.
        parts: What is asked of them.
        data: The arrays without rows.
    """

    def __init__(self, tiles: Tiles, parts: Sequence[Normals | Density], data: Columns) -> None:
        self._tiles, self._parts, self._names = tiles, parts, list(data)
        fields = [(name, values.dtype, values.shape[1:]) for name, values in data.items()]
        self.dtype = np.dtype([("row", np.int64), *fields])

    def __len__(self) -> int:
        return len(self._tiles)

    def of(self, number: int) -> NDArray[Any]:
        """The arrays of a tile's points, by row."""
        own = self._tiles.own(number)
        records = np.empty(len(own), self.dtype)
        records["row"] = own["row"]
        for part in self._parts:
            for rows, found in part.of(self._tiles, own):
                places = np.searchsorted(own["row"], rows)
                for name, values in found.items():
                    records[name][places] = values
        return records

    def save(self, path: Path) -> None:
        """Write what workers need: the tiles' boxes are too much to send with each task."""
        with open(path, "wb") as file:
            pickle.dump(self, file, protocol=5)


# The folder is new for each call, and so is the file's name.
@functools.lru_cache(maxsize=1)
def _loaded(path: Path) -> TileAnswers:
    with open(path, "rb") as file:
        answers: TileAnswers = pickle.load(file)
    return answers


def answer_on_worker(path: Path, number: int, folder: Path) -> Path:
    """:meth:`TileAnswers.of` in another process, into a file of the folder, which both must see.

    Raises:
        WorkerError: The folder is not there.
    """
    require_seen(path, folder.parent)
    records = _loaded(path).of(number)
    handle, name = tempfile.mkstemp(dir=folder)
    with open(handle, "wb") as file:
        file.write(records.data)
    return Path(name)
