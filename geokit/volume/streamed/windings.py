"""Exact winding numbers on a lattice, from one that is known and the triangles that lie between."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.volume.streamed.crossings import crossings, extent

__all__ = ["ColumnWindings", "CornerWindings", "in_parts"]

# Triangles that are looked at together.
AT_A_TIME = 1 << 14
Coordinates = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def in_parts(rows: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Rows of an array, some at a time."""
    for first in range(0, len(rows), AT_A_TIME):
        yield rows[first : first + AT_A_TIME]


class CornerWindings:
    """Winding numbers at few lattice points, for which many triangles are looked at one after the other.

    The way to a point runs along x, then y, then z. A crossing before the first point of a line counts at all points
    of the line alike, and so not at all.

    Args:
        lattice: Ascending coordinates of the points along each axis.
        known: Winding number at the first point.
    """

    def __init__(self, lattice: Coordinates, known: int) -> None:
        self.lattice, self.known = lattice, known
        x, y, z = (len(axis) for axis in lattice)
        self._along = [np.zeros(shape, np.int64) for shape in ((x + 1,), (x, y + 1), (x, y, z + 1))]

    def add(self, corners: NDArray[np.float64]) -> None:
        """Look at more triangles, (N, 3, 3)."""
        x, y, z = self.lattice
        box = extent(corners)
        for found in crossings(corners, box, 0, y[:1], z[:1], x):
            np.add.at(self._along[0], found.station, found.change)
        for found in crossings(corners, box, 1, z[:1], x, y):
            np.add.at(self._along[1], (found.line_v, found.station), found.change)
        for found in crossings(corners, box, 2, x, y, z):
            np.add.at(self._along[2], (found.line_u, found.line_v, found.station), found.change)

    def numbers(self) -> NDArray[np.int64]:
        """Winding numbers of the points, (X, Y, Z)."""
        x, y, z = (np.cumsum(part[..., 1:-1], axis=-1) for part in self._along)
        x, y, z = (np.concatenate([np.zeros((*part.shape[:-1], 1), np.int64), part], axis=-1) for part in (x, y, z))
        return np.asarray(self.known + x[:, None, None] + y[:, :, None] + z)


class ColumnWindings:
    """Winding numbers at any points of a large lattice, from triangles that are all at hand.

    Args:
        corners: The triangles, (N, 3, 3).
        lattice: Ascending coordinates of the points along each axis.
        known: Winding number at the first point.
    """

    def __init__(self, corners: NDArray[np.generic], lattice: Coordinates, known: int) -> None:
        x, y, z = lattice
        floor = CornerWindings((x, y, z[:1]), known)
        keys, changes = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        self._shape = len(x), len(y), len(z)
        for part in in_parts(corners):
            part = part.astype(np.float64)
            floor.add(part)
            for found in crossings(part, extent(part), 2, x, y, z):
                used = (found.station > 0) & (found.station < len(z))
                keys.append(self._key(found.line_u, found.line_v, found.station)[used])
                changes.append(found.change[used])
        self._floor = floor.numbers()[:, :, 0].reshape(-1)
        key, change = np.concatenate(keys), np.concatenate(changes)
        order = np.argsort(key, kind="stable")
        self._keys = key[order]
        whole = np.cumsum(change[order])
        column = self._keys // len(z)
        starts = np.searchsorted(column, column)
        self._sums = whole - np.where(starts > 0, whole[starts - 1], 0)

    def _key(self, x: NDArray[np.int64], y: NDArray[np.int64], z: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.asarray((x * self._shape[1] + y) * self._shape[2] + z)

    def at(self, places: NDArray[np.int64]) -> NDArray[np.int64]:
        """Winding numbers at points, which are given by their places along each axis, (N, 3)."""
        key = self._key(*places.T)
        column = key // self._shape[2]
        numbers = self._floor[column]
        if len(self._keys):
            last = np.searchsorted(self._keys, key, "right") - 1
            below = (last >= 0) & (self._keys[last] // self._shape[2] == column)
            numbers = numbers + np.where(below, self._sums[last], 0)
        return np.asarray(numbers)
