"""Branch and bound for the largest distance of one surface from another: triangles are cut until bounds suffice."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory.host_array import HostArray
from geokit.mesh.model.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface


class TrianglePieces(NamedTuple):
    """Pieces of triangles, P of them, with the distances and bounds known for them."""

    face: NDArray[np.int64]  # (P,), the triangle that it is a piece of
    corners: NDArray[np.float64]  # (P, 3, 3): piece, corner, axis [world]
    distance: NDArray[np.float64]  # (P, 3), of the corners
    triangle: NDArray[np.int32]  # (P, 3), the corners' closest triangles
    candidate: NDArray[np.int32]  # (P,), the triangle that gave the bound
    upper: NDArray[np.float64]  # (P,), bound of the distance anywhere in the piece
    depth: NDArray[np.int32]  # (P,), number of cuts that led to the piece
    edge: NDArray[np.int32]  # (P,), the edge to cut if that bound is too large; edge k starts at corner k
    cut: NDArray[np.float64]  # (P, 3), point on that edge where it is cut [world]

    def take(self, rows: NDArray[Any]) -> TrianglePieces:
        chosen = np.flatnonzero(rows) if rows.dtype == bool else rows  # take() is several times faster than indexing
        return TrianglePieces._make(column.take(chosen, axis=0) for column in self)


class DistanceSearch:
    """Branch and bound for the largest distance of a mesh from a surface.

    A piece is done once its bound exceeds the largest distance found by no more than the gap. Of all done pieces only
    the largest bound is kept.
    """

    def __init__(self, target: Surface, gap: float, rounding: float) -> None:
        from geokit.mesh.queries.hausdorff_kernels import Target

        self.lower, self.done_upper = -math.inf, 0.0
        self.point = self.closest = np.full(3, math.nan)
        self._surface, self._gap, self._rounding = target, gap, rounding
        self._device: "wp.Device" = target._device
        self._target = Target()
        self._target.vertices, self._target.faces = target._vertices, target._faces

    def measure(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Distances of points of the mesh and their closest triangles; updates the largest distance found."""
        found: Any = self._surface.closest_point(points)
        if len(points):
            row = int(np.argmax(found.distance))
            if found.distance[row] > self.lower + self._rounding:
                self.lower = float(found.distance[row])
                self.point, self.closest = points[row].copy(), found.points[row].copy()
        return found.distance, found.triangle_id

    def measure_vertices(self, mesh: TriangleMesh) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Distances and closest triangles of all vertices; NaN and -1 for vertices that no face uses."""
        used = np.zeros(len(mesh.vertices), bool)
        used[mesh.faces.ravel()] = True
        distance, triangle = np.full(len(used), math.nan), np.full(len(used), -1, np.int32)
        distance[used], triangle[used] = self.measure(mesh.vertices[used])
        return distance, triangle

    def run(self, mesh: TriangleMesh, distance: NDArray[np.float64], triangle: NDArray[np.int32]) -> None:
        """Close the gap between ``lower`` and ``upper`` over all triangles, given the answers for the vertices."""
        waiting: list[TrianglePieces] = []
        for start in range(0, len(mesh.faces), BLOCK):
            faces = mesh.faces[start : start + BLOCK]
            face = np.arange(start, start + len(faces))
            waiting.append(self._first_pieces(face, mesh.vertices[faces], distance[faces], triangle[faces]))
        pieces = joined_pieces(waiting)
        while True:
            pieces = self._undecided(pieces)
            if len(pieces.upper) == 0:
                return
            chosen = self._next_rows(pieces)
            rest = np.delete(np.arange(len(pieces.upper)), chosen)
            halves = self._halves(pieces.take(chosen))
            pieces = joined_pieces([pieces.take(rest), halves]) if len(rest) else halves

    @property
    def upper(self) -> float:
        return max(self.lower, self.done_upper)

    def _first_pieces(
        self,
        face: NDArray[np.int64],
        corners: NDArray[np.float64],
        distance: NDArray[np.float64],
        triangle: NDArray[np.int32],
    ) -> TrianglePieces:
        """The whole triangles that neither their corners nor the triangle closest to their center decide."""
        count = len(corners)
        unknown = np.full(count, math.inf), np.zeros(count, np.int32), np.empty(count, np.int32), np.empty((count, 3))
        pieces = TrianglePieces(face, corners, distance, triangle, triangle[:, 0].copy(), *unknown)
        self._bound(pieces)
        pieces = self._undecided(pieces)
        pieces.candidate[:] = self.measure(pieces.corners.mean(axis=1))[1]
        self._bound(pieces)
        return self._undecided(pieces)

    def _undecided(self, pieces: TrianglePieces) -> TrianglePieces:
        undecided = pieces.upper > self.lower + self._gap
        self.done_upper = max(self.done_upper, float(np.max(pieces.upper[~undecided], initial=0.0)))
        return pieces if undecided.all() else pieces.take(undecided)

    def _next_rows(self, pieces: TrianglePieces) -> NDArray[np.int64]:
        count = len(pieces.upper)
        if count <= BLOCK or count > MOST_WAITING:
            return np.arange(max(0, count - BLOCK), count)
        return np.argpartition(pieces.upper, count - BLOCK)[count - BLOCK :]

    def _halves(self, pieces: TrianglePieces) -> TrianglePieces:
        """Each piece cut in two, with new bounds."""
        distance, triangle = self.measure(pieces.cut)
        both = joined_pieces([pieces, pieces])
        rows = np.arange(len(both.upper))
        replaced = np.concatenate([pieces.edge, (pieces.edge + 1) % 3])
        both.corners[rows, replaced] = both.cut
        both.distance[rows, replaced] = np.tile(distance, 2)
        both.triangle[rows, replaced] = np.tile(triangle, 2)
        both.depth[:] += 1
        self._bound(both)
        return both

    def _bound(self, pieces: TrianglePieces) -> None:
        from geokit.mesh.queries.hausdorff_kernels import bound_kernel

        flat = pieces.corners.reshape(-1, 3), pieces.distance.reshape(-1), pieces.triangle.reshape(-1), pieces.depth
        enough, least_gap = wp.float64(self.lower + self._gap), wp.float64(CUT_SHARE * self._gap)
        inputs = [*(self._sent(array) for array in flat), self._target, enough, least_gap]
        self._launch(bound_kernel, len(pieces.upper), inputs, [pieces.candidate, pieces.upper, pieces.edge, pieces.cut])

    def _sent(self, array: NDArray[Any]) -> Any:
        host = HostArray(np.ascontiguousarray(array))
        return host if self._device.is_cpu else host.warp.to(self._device)

    def _launch(self, kernel: Any, count: int, inputs: list[Any], results: list[NDArray[Any]]) -> None:
        """Run the kernel; it updates the arrays in ``results`` in place."""
        if count == 0:
            return
        outputs = [self._sent(array) for array in results]
        launcher.launch(kernel, count, inputs, outputs, self._device)
        for array, output in zip(results, outputs, strict=True):
            if not self._device.is_cpu:
                array[:] = output.numpy()


# Pieces that are cut in one round, about 60 MB with their halves.
BLOCK = 1 << 17


# While fewer pieces than this wait (152 bytes each), those with the largest bounds are cut first, which raises the
# lower bound soonest. Above it the newest are cut first: they number at most a block for each halving of an edge.
MOST_WAITING = 1 << 20


# An edge is cut where its closest triangles change, if their distances differ by this share of the remaining gap.
CUT_SHARE = 0.25


def joined_pieces(parts: list[TrianglePieces]) -> TrianglePieces:
    return TrianglePieces(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
