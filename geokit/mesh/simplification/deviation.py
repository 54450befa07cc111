"""Decide by bounds, not by samples, whether two surfaces are within a distance of each other everywhere."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.queries.hausdorff import DistanceSearch, TrianglePieces
from geokit.mesh.surfaces.surface import Surface

__all__ = ["within"]

# A distance within this share below the limit counts as beyond it: deciding exactly would take long.
SLACK = 0.01


def within(one: Surface, other: Surface, limit: float) -> bool:
    """Whether no point of either surface is farther than the limit from the other surface.

    True is proven for all points of the triangles. False is certain, except for distances less than 1% below the limit.

    Args:
        one: A surface, the larger one: its vertices are measured last.
        other: Another surface on the same device.
        limit: Distance [world], above 0.
    """
    there, back = _Decision(one, limit), _Decision(other, limit)
    there_vertices = there.measure_vertices(other.mesh)
    if there.lower > limit:
        return False
    back_vertices = back.measure_vertices(one.mesh)
    if back.lower > limit:
        return False
    there.run(other.mesh, *there_vertices)
    if there.upper > limit:
        return False
    back.run(one.mesh, *back_vertices)
    return back.upper <= limit


class _Decision(DistanceSearch):
    """A search for the largest distance that drops every piece proven to be within the limit."""

    def __init__(self, target: Surface, limit: float) -> None:
        super().__init__(target, limit, 0.0)
        self._limit = limit

    def measure(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        answer = super().measure(points)
        # All bounds up to the limit are good enough, so the gap is what the lower bound leaves to it.
        self._gap = max(SLACK * self._limit, self._limit - self.lower)
        return answer

    def _undecided(self, pieces: TrianglePieces) -> TrianglePieces:
        if self.upper > self._limit:
            # Beyond the limit: the remaining pieces cannot change that.
            none_left: NDArray[Any] = np.zeros(0, np.int64)
            return pieces.take(none_left)
        return super()._undecided(pieces)
