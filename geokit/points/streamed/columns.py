"""Normals and densities of the points of a tile, from the points around it: those of the whole cloud."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.interop.user_arrays import read_vectors
from geokit.errors import DeviceMemoryError
from geokit.formats.columns import Columns
from geokit.points._density import density
from geokit.points._normals import planes, turn_towards
from geokit.points.streamed.tiles import Tiles

# Roundings of squared distances: points within a rounded radius are within this factor of it, and within that more.
RELATIVE, ABSOLUTE = 1e-15, 1e-161
# Points of a tile whose nearest points reach beyond the points around the tile: so many are looked up one by one.
FEW = 256
# Points of a tile that say how far the nearest points are, and how much farther they may be elsewhere in it: for random
# points the largest of so many is a quarter above the mean, and the rest is beyond that of any.
ASKED, SPARE = 32, 1.3


def longest_reach(radius: float) -> float:
    """Half edge of a cube that has all points within the radius, roundings included."""
    return radius * (1.0 + RELATIVE) + ABSOLUTE


class Around:
    """Points within a box around some points.

    Attributes:
        records: The points by row.
        own: Places of those that are asked about.
    """

    def __init__(self, tiles: Tiles, own: NDArray[Any], reach: float, most: int) -> None:
        points = own["points"]
        # Rounded outwards.
        self.lower = np.nextafter(points.min(axis=0) - reach, -np.inf)
        self.upper = np.nextafter(points.max(axis=0) + reach, np.inf)
        self.records = tiles.around(self.lower, self.upper, most)
        if self.records is not None:
            self.own = np.searchsorted(self.records["row"], own["row"])


def _halves(own: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Points on either side of the middle of their longest side; all on one side where they lie in one place."""
    points = own["points"]
    sides = points.max(axis=0) - points.min(axis=0)
    axis = int(np.argmax(sides))
    above = points[:, axis] > points[:, axis].min() + 0.5 * sides[axis]
    return own[~above], own[above]


class Density:
    """Densities, as of :func:`geokit.points.density`.

    Args:
        options: Its arguments.
        most: Points that may be in memory.
        device: Name of the device to compute on.
    """

    # Memory for a point with its cells, while these are made, and with its record.
    BYTES_PER_POINT = 220

    def __init__(self, options: Mapping[str, Any], most: int, device: str) -> None:
        self._options, self.most, self._device = options, most, device
        self._reach = longest_reach(float(options["radius"]))

    def of(self, tiles: Tiles, own: NDArray[Any]) -> Iterator[tuple[NDArray[np.int64], Columns]]:
        """Rows of points with their densities, some at a time."""
        around = Around(tiles, own, self._reach, self.most)
        if around.records is None:
            for part in smaller(own, self._reach, "density", self.most):
                yield from self.of(tiles, part)
            return
        points = np.ascontiguousarray(around.records["points"])
        queries = points[around.own]
        found = density(points, queries=queries, **self._options, device=self._device)
        yield around.records["row"][around.own], {"density": np.asarray(found)}


def smaller(own: NDArray[Any], reach: float, name: str, most: int) -> list[NDArray[Any]]:
    """Parts of points that have less around them.

    Raises:
        DeviceMemoryError: The points around them are too many in any case.
    """
    points = own["points"]
    if float((points.max(axis=0) - points.min(axis=0)).max()) <= 0.25 * reach:
        raise DeviceMemoryError(
            f"{name}: more than {most} points lie within the radius of those near {points[0].tolist()}, which is what "
            "memory_limit allows; give more memory, or a smaller radius"
        )
    return [part for part in _halves(own) if len(part)]


class Normals:
    """Normals and curvatures, as of :func:`geokit.points.normals`.

    Args:
        k: Number of nearest points.
        radius: Radius of the neighborhoods; None for the nearest points.
        viewpoint: Where normals point to; None if nowhere.
        most: Points that may be in memory.
        device: Name of the device to compute on.
    """

    def __init__(self, k: int, radius: float | None, viewpoint: list[float] | None, most: int, device: str) -> None:
        self._k, self._radius, self._viewpoint, self.most, self._device = k, radius, viewpoint, most, device
        self._reach = 0.0 if radius is None else longest_reach(radius)

    @staticmethod
    def bytes_per_point(k: int) -> int:
        """Memory for a point with its nearest ones and its record."""
        return 320 + 20 * k

    def of(self, tiles: Tiles, own: NDArray[Any]) -> Iterator[tuple[NDArray[np.int64], Columns]]:
        """Rows of points with their normals and curvatures, some at a time."""
        if self._radius is None:
            yield from self._nearest(tiles, own, self._usual_reach(tiles, own))
            return
        around = Around(tiles, own, self._reach, self.most)
        if around.records is None:
            for part in smaller(own, self._reach, "normals", self.most):
                yield from self.of(tiles, part)
            return
        yield self._fitted(around.records, around.own)[0]

    def _nearest(self, tiles: Tiles, own: NDArray[Any], reach: float) -> Iterator[tuple[NDArray[np.int64], Columns]]:
        """Those of the nearest points, which are all found within a reach, or beyond it."""
        around = Around(tiles, own, reach, self.most)
        if around.records is None:
            parts = [part for part in _halves(own) if len(part)]
            if len(parts) < 2 and len(own) >= self._k:
                # All in one place, where no plane is.
                yield own["row"], {"normals": np.zeros((len(own), 3)), "curvature": np.zeros(len(own))}
            elif len(parts) < 2 or len(own) <= FEW:
                yield from self._alone(tiles, own)
            else:
                for part in parts:
                    yield from self.of(tiles, part)
            return
        (rows, data), farthest = self._fitted(around.records, around.own)
        # Nothing lies beyond the box of all points.
        clear = np.full(len(own), np.inf)
        for axis in range(3):
            along = around.records["points"][around.own, axis]
            if around.lower[axis] > tiles.known.lower[axis]:
                clear = np.minimum(clear, along - around.lower[axis])
            if around.upper[axis] < tiles.known.upper[axis]:
                clear = np.minimum(clear, around.upper[axis] - along)
        clear *= 1.0 - RELATIVE
        if len(around.records) < min(self._k, tiles.known.count):
            farthest[:] = np.inf
        sure = (farthest < clear) | np.isposinf(clear)
        yield rows[sure], {name: values[sure] for name, values in data.items()}
        rest, wanted = around.records[around.own[~sure]], farthest[~sure]
        del around, rows, data, clear
        if len(rest) <= FEW:
            yield from self._alone(tiles, rest)
            return
        # Far enough for all but a few.
        further = float(np.sort(wanted)[len(rest) - FEW])
        yield from self._nearest(tiles, rest, max(further if np.isfinite(further) else 0.0, 2.0 * reach))

    def _alone(self, tiles: Tiles, own: NDArray[Any]) -> Iterator[tuple[NDArray[np.int64], Columns]]:
        """Those of points whose neighbors are looked up one by one."""
        k = min(self._k, tiles.known.count)
        step = max(1, self.most // (k + 1))
        for first in range(0, len(own), step):
            some = own[first : first + step]
            # Where more points than asked for lie in its place, a point is not among its own nearest ones.
            near = np.concatenate([some, *(tiles.nearest(record["points"], k) for record in some)])
            rows, places = np.unique(near["row"], return_index=True)
            yield self._fitted(near[places], np.searchsorted(rows, some["row"]))[0]

    def _fitted(
        self, records: NDArray[Any], own: NDArray[np.int64]
    ) -> tuple[tuple[NDArray[np.int64], Columns], NDArray[np.float64]]:
        """Rows, normals and curvatures, and distances of the farthest neighbors."""
        device = launcher.resolve_device(self._device)
        batch = read_vectors(np.ascontiguousarray(records["points"]), "points", device)
        normal, curvature, graph = planes(batch.array, self._k, self._radius, device)
        if self._viewpoint is not None:
            turn_towards(normal, batch.array, self._viewpoint, device)
        farthest = np.zeros(len(own)) if graph is None else graph.distance.numpy()[own, -1]
        data = {"normals": normal.numpy()[own], "curvature": curvature.numpy()[own]}
        return (records["row"][own], data), farthest

    def _usual_reach(self, tiles: Tiles, own: NDArray[Any]) -> float:
        """A distance beyond that of the farthest of the nearest points, for all but a few."""
        farthest = 0.0
        for record in own[:: max(1, len(own) // ASKED)]:
            apart = tiles.nearest(record["points"], self._k)["points"] - record["points"]
            farthest = max(farthest, float(np.linalg.norm(apart, axis=1).max()))
        return SPARE * farthest
