"""Where a mesh and what it was made from are farther from each other than a limit: by bounds, not by samples."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.queries.hausdorff import DistanceSearch, TrianglePieces
from geokit.mesh.simplification.invariants import turned_faces
from geokit.mesh.surfaces.surface import Surface

# A distance within this share below the limit counts as beyond it: deciding exactly would take long.
SLACK = 0.01


class Proof:
    """What is proven of the last trial: faces that the next one has too are not looked at again.

    Args:
        original: The original surface.
        limit: Distance [world], above 0.
        oriented: Whether faces are to face the way of the original's.
    """

    def __init__(self, original: Surface, limit: float, oriented: bool) -> None:
        self._original, self._limit, self._oriented = original, limit, oriented
        corners = original.mesh.vertices[original.mesh.faces]
        self._middle = corners.mean(axis=1)
        # Farther from its middle than this is no triangle that proves anything of a face; rounded up.
        reach = limit + np.linalg.norm(corners - self._middle[:, None], axis=2).max(axis=1)
        self._reach = (1.0 + 1e-12) * reach
        # Of the last trial: corners of each face of the original that is left, NaN for others; whether each was wrong.
        self._left = np.full(corners.shape, np.nan)
        self._wrong_there = np.ones(len(corners), bool)
        # Whether each face of the original is far from the last trial.
        self._far = np.ones(len(corners), bool)

    def wrong(self, surface: Surface, source: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether each face of the original lies where a trial is farther than the limit, or faces the other way (F,).

        Args:
            surface: The trial, on the device of the original.
            source: The face of the original that each of its faces was.
        """
        mesh, original = surface.mesh, self._original.mesh
        corners = mesh.vertices[mesh.faces]
        rows = np.flatnonzero((corners != self._left[source]).any(axis=(1, 2)) | self._wrong_there[source])
        gone = ~np.isnan(self._left[:, 0, 0])
        gone[np.delete(source, rows)] = False
        if gone.any():
            # What is proven by faces that are still there stays proven.
            faces = np.arange(3 * gone.sum()).reshape(-1, 3)
            before = Surface(TriangleMesh(self._left[gone].reshape(-1, 3), faces), device=surface.device)
            self._far |= before.closest_point(self._middle).distance <= self._reach
        again = np.flatnonzero(self._far)
        left = TriangleMesh(original.vertices, original.faces[again])
        self._far[again] = ~np.isnan(far_faces(left, surface, self._limit)[:, 0])
        new = TriangleMesh(mesh.vertices, mesh.faces[rows])
        place = far_faces(new, self._original, self._limit)
        if self._oriented:
            turned = turned_faces(new, self._original, self._limit)
            place[turned] = corners[rows[turned]].mean(axis=1)
        there = ~np.isnan(place[:, 0])
        self._left[:], self._left[source] = np.nan, corners
        self._wrong_there[:], self._wrong_there[source[rows[there]]] = False, True
        wrong = self._far.copy()
        if there.any():
            wrong[self._original.closest_point(place[there]).triangle_id] = True
        return wrong


def far_faces(mesh: TriangleMesh, surface: Surface, limit: float, slack: float | None = None) -> NDArray[np.float64]:
    """A point of each face that is farther than the limit from a surface (F, 3); NaN for faces that have none.

    NaN is proven for all points of the triangle. A point is certain, except for distances within the slack below it.

    Args:
        mesh: The mesh.
        surface: What distances are measured from.
        limit: Distance [world], above 0.
        slack: None for 1% of that.
    """
    search = _FarFaces(surface, limit, SLACK * limit if slack is None else slack, mesh.face_count)
    search.run(mesh, *search.measure_vertices(mesh))
    return search.point_of


class _FarFaces(DistanceSearch):
    """A search that drops pieces within the limit, and all pieces of faces that have a point beyond it."""

    def __init__(self, target: Surface, limit: float, slack: float, face_count: int) -> None:
        super().__init__(target, slack, 0.0)
        self.lower, self._limit = limit - slack, limit
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
