"""Whether two surfaces are within a distance of each other everywhere, decided by bounds and not by samples."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.mesh._surface import Surface
from geokit.mesh.queries.hausdorff import DistanceSearch, TrianglePieces

__all__ = ["within"]

# Where the distance comes as near to the limit as this share of it, it counts as beyond: deciding would take long.
SLACK = 0.01


def within(one: Surface, other: Surface, limit: float) -> bool:
    """Whether no point of either surface is farther than the limit from the other surface.

    True is proven for all points of the triangles; False is certain but within 1% below the limit.

    Args:
        one: A surface; the larger one, whose vertices are asked last.
        other: Another on the same device.
        limit: Distance [world], above 0.
    """
    there, back = _Decision(one, limit), _Decision(other, limit)
    there_vertices = there.ask_vertices(other.mesh)
    if there.lower > limit:
        return False
    back_vertices = back.ask_vertices(one.mesh)
    if back.lower > limit:
        return False
    there.run(other.mesh, *there_vertices)
    if there.upper > limit:
        return False
    back.run(one.mesh, *back_vertices)
    return back.upper <= limit


class _Decision(DistanceSearch):
    """The search for the largest distance, which lets go of what is proven to be within the limit."""

    def __init__(self, target: Surface, limit: float) -> None:
        super().__init__(target, limit, 0.0)
        self._limit = limit

    def ask(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        answer = super().ask(points)
        # Bounds up to the lower one and this gap are good enough: up to the limit all of them are.
        self._gap = max(SLACK * self._limit, self._limit - self.lower)
        return answer

    def _undecided(self, pieces: TrianglePieces) -> TrianglePieces:
        if self.upper > self._limit:
            # Beyond: nothing that is left can change that.
            nothing: NDArray[Any] = np.zeros(0, np.int64)
            return pieces.take(nothing)
        return super()._undecided(pieces)
