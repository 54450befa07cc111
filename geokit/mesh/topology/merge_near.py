"""Merging of vertices within a tolerance: each group becomes its first vertex."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from geokit.core.equal_rows import merge_equal_points
from geokit.errors import InputError

# Points that the average point may have within the tolerance. Points that belong together are a handful. A tolerance
# with this many is far above the mesh's resolution, and the time grows with the number of pairs.
MAX_CROWD = 512
# Rounds in which all points are decided at once whose earlier neighbors are decided. Only rows of points that each wait
# for the previous one take so many; after these rounds they are decided one by one.
ROUNDS = 32


def merge_near_points(points: NDArray[np.float64], tolerance: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Decide in order which points stay: a point that is not absorbed yet stays, and absorbs later ones within
    tolerance.

    Args:
        points: Shape (N, 3), N > 0, no two equal.
        tolerance: Distance above 0.
    Returns:
        ``kept`` (U,), ascending: the points that stay; and ``group`` (N,), an index into ``kept`` for each point: that
        of the point itself, or of the first remaining point within the tolerance.
    """
    earlier, later = _pairs_within(points, tolerance)
    taken = _absorbed(len(points), earlier, later)
    target = np.arange(len(points))
    stays = ~taken[earlier]
    np.minimum.at(target, later[stays], earlier[stays])
    kept = np.flatnonzero(~taken)
    return kept, np.searchsorted(kept, target)


def _pairs_within(points: NDArray[np.float64], tolerance: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All pairs of points within the tolerance, sorted by the earlier point."""
    from geokit.points.neighbors.neighbor_grid import NeighborGrid

    # Scaled to unit size, so that squares of lengths neither overflow nor underflow; a power of two does not round.
    exponent = -math.frexp(float(np.abs(points).max()))[1]
    points, radius = np.ldexp(points, exponent), math.ldexp(min(tolerance, math.ldexp(4.0, -exponent)), exponent)
    if radius == 0.0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    _require_room(points, radius, tolerance)
    found = NeighborGrid(points, radius, device="cpu").radius_search(points)
    one = np.repeat(np.arange(len(points)), np.diff(found.offsets))
    other = found.indices.astype(np.int64)
    ahead = other < one
    return other[ahead], one[ahead]


def _require_room(points: NDArray[np.float64], radius: float, tolerance: float) -> None:
    if len(points) <= MAX_CROWD:
        return
    # All points in a cell of this edge length are within the radius of each other.
    _, cell = merge_equal_points(np.floor((points - points.min(axis=0)) / max(radius / math.sqrt(3.0), 2.0**-50)))
    crowd = float(np.square(np.bincount(cell).astype(np.float64)).sum()) / len(points)
    if crowd > MAX_CROWD:
        raise InputError(
            f"tolerance: {tolerance:g} takes in {crowd:.0f} vertices around the average one; it is meant for vertices "
            "that should be one: give a distance below the length of the mesh's edges"
        )


def _absorbed(count: int, earlier: NDArray[np.int64], later: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Points that an earlier one absorbs, (count,) bool."""
    taken = np.zeros(count, bool)
    for _ in range(ROUNDS):
        if not len(later):
            return taken
        waits = np.zeros(count, bool)
        waits[later] = True
        taken[later[~waits[earlier]]] = True
        open_ = ~(taken[later] | taken[earlier])
        earlier, later = earlier[open_], later[open_]
    by_later = np.argsort(later, kind="stable")
    for before, point in zip(earlier[by_later].tolist(), later[by_later].tolist(), strict=True):
        if not taken[before]:
            taken[point] = True
    return taken
