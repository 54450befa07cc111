"""The faces of a surface that are not within a distance of another one everywhere: by bounds, not by samples."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.queries.hausdorff import DistanceSearch, TrianglePieces
from geokit.mesh.surfaces.surface import Surface

__all__ = ["far_faces"]

# A distance within this share below the limit counts as beyond it: deciding exactly would take long.
SLACK = 0.01


def far_faces(mesh: TriangleMesh, surface: Surface, limit: float) -> NDArray[np.float64]:
    """A point of each face that is farther than the limit from a surface (F, 3); NaN for faces that have none.

    NaN is proven for all points of the triangle. A point is certain, except for distances less than 1% below the limit.

    Args:
        mesh: The mesh.
        surface: What distances are measured from.
        limit: Distance [world], above 0.
    """
    search = _FarFaces(surface, limit, mesh.face_count)
    search.run(mesh, *search.measure_vertices(mesh))
    return search.point_of


class _FarFaces(DistanceSearch):
    """A search that drops pieces within the limit, and all pieces of faces that have a point beyond it."""

    def __init__(self, target: Surface, limit: float, face_count: int) -> None:
        super().__init__(target, SLACK * limit, 0.0)
        self.lower, self._limit = (1.0 - SLACK) * limit, limit
        self.point_of = np.full((face_count, 3), np.nan)

    def measure(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        found: Any = self._surface.closest_point(points)
        return found.distance, found.triangle_id

    def _undecided(self, pieces: TrianglePieces) -> TrianglePieces:
        wide = pieces.upper > self._limit
        corner = pieces.distance.argmax(axis=1)
        far = np.flatnonzero(wide & (pieces.distance[np.arange(len(corner)), corner] > self.lower))
        self.point_of[pieces.face[far]] = pieces.corners[far, corner[far]]
        return pieces.take(wide & np.isnan(self.point_of[pieces.face, 0]))
