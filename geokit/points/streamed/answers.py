"""The arrays that are added to the points of a tile, here or on a worker."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geokit.formats.blocks.workers import Done
from geokit.formats.columns import Columns
from geokit.points.streamed.columns import Density, Normals
from geokit.points.streamed.tiles import Tiles

__all__ = ["TileAnswers"]


class TileAnswers:
    """Arrays by tile.

    Args:
        tiles: The points.
        parts: What is asked of them.
        data: The arrays without rows.
    """

    def __init__(self, tiles: Tiles, parts: Sequence[Normals | Density], data: Columns) -> None:
        self._tiles, self._parts = tiles, parts
        fields = [(name, values.dtype, values.shape[1:]) for name, values in data.items()]
        self.dtype = np.dtype([("row", np.int64), *fields])

    def make(self, number: int, _: Path) -> Done:
        """The arrays of a tile's points, by row."""
        own = self._tiles.own(number)
        records = np.empty(len(own), self.dtype)
        records["row"] = own["row"]
        for part in self._parts:
            for rows, found in part.of(self._tiles, own):
                places = np.searchsorted(own["row"], rows)
                for name, values in found.items():
                    records[name][places] = values
        return Done(records)
