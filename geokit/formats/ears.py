"""Triangulation of a simple polygon of the plane, ear by ear."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

__all__ = ["clip_ears"]

# Corners in a cell of the grid in which blocking corners are looked up, on average; and cells that are looked at one
# by one before all corners are tested at once.
CELL_CORNERS, MOST_CELLS = 2.0, 64
# Polygons of more corners are clipped all around in turn.
FEW = 64


def clip_ears(flat: NDArray[np.float64]) -> list[tuple[int, int, int]]:
    """Triangulate a counter-clockwise simple polygon.

    Of few corners, the first ear is cut off at each step. Of many, ears are cut off all around in turn, so that they
    stay small, in a time of n log n for most outlines. No triangle is turned over. A polygon that crosses itself may
    run out of ears; then its flattest corner is cut off.

    Args:
        flat: Corners, shape (n, 2).
    Returns:
        Triangles of corner indices, n - 2 of them.
    Source:
        Meisters, Polygons have ears (1975).
    """
    return _Ring(flat).clipped() if len(flat) > FEW else _slowly_clipped(flat, list(range(len(flat))))


class _Ring:
    """The corners that are left.

    A corner's angle only becomes smaller when a neighbor is cut off, so an ear stays one until a neighbor goes, and a
    corner that something blocks needs another look only when that is cut off or becomes convex. So each corner is
    looked at a few times, and each look tests only the corners that are not convex in cells near by.
    """

    def __init__(self, flat: NDArray[np.float64]) -> None:
        count = len(flat)
        self.flat = flat
        self.x, self.y = flat[:, 0].tolist(), flat[:, 1].tolist()
        self.before = [count - 1, *range(count - 1)]
        self.after = [*range(1, count), 0]
        self.left = count
        before, after = np.roll(flat, 1, axis=0), np.roll(flat, -1, axis=0)
        turn = _cross(flat - before, after - flat)
        self.turn = turn.tolist()
        # Only corners that are not convex can lie in an ear.
        self.blocks = (turn <= 0.0).tolist()
        blocking = np.flatnonzero(turn <= 0.0)
        self.blocking, self.open = blocking, len(blocking)
        low = flat.min(axis=0)
        self.low = low.tolist()
        # Corners that rounding turns over are left to the slow way.
        self.sound = True
        across, along = np.sort(flat.max(axis=0) - low)
        share = CELL_CORNERS / max(len(blocking), 1)
        # Square cells, so that outlines along a line have as few corners in each.
        self.scale = 1.0 / (max(float(np.sqrt(across * along * share)), float(along) * share) or 1.0)
        places = ((flat[blocking] - low) * self.scale).astype(np.int64).tolist()
        self.grid: dict[tuple[int, int], list[int]] = {}
        for corner, (column, row) in zip(blocking.tolist(), places, strict=True):
            self.grid.setdefault((column, row), []).append(corner)
        self.waiting: dict[int, list[int]] = {}
        self.gone = [False] * count
        self.asked = [True] * count

    def clipped(self) -> list[tuple[int, int, int]]:
        triangles: list[tuple[int, int, int]] = []
        # Corners that may be ears.
        queue = deque(range(len(self.turn)))
        while self.left > 3 and queue and self.sound:
            corner = queue.popleft()
            self.asked[corner] = False
            if self.gone[corner] or not self.turn[corner] > 0.0:
                continue
            blocker = self._blocker(corner)
            if blocker >= 0:
                self.waiting.setdefault(blocker, []).append(corner)
                continue
            triangles.append((self.before[corner], corner, self.after[corner]))
            for again in self._cut(corner):
                if not self.asked[again]:
                    self.asked[again] = True
                    queue.append(again)
        ring = [corner for corner, gone in enumerate(self.gone) if not gone]
        return triangles + _slowly_clipped(self.flat, ring)

    def _cut(self, corner: int) -> list[int]:
        """Take a corner out; returns the corners that need another look."""
        a, b = self.before[corner], self.after[corner]
        self.after[a], self.before[b] = b, a
        self.gone[corner] = True
        self.left -= 1
        again = self.waiting.pop(corner, [])
        for near in (a, b):
            before, after = self.before[near], self.after[near]
            x, y = self.x, self.y
            self.turn[near] = (x[near] - x[before]) * (y[after] - y[near]) - (y[near] - y[before]) * (
                x[after] - x[near]
            )
            if self.blocks[near] and self.turn[near] > 0.0:
                self.blocks[near] = False
                self.open -= 1
                again += self.waiting.pop(near, [])
            elif not self.blocks[near] and self.turn[near] <= 0.0:
                self.sound = False
            again.append(near)
        return again

    def _blocker(self, corner: int) -> int:
        """A corner in the triangle of a corner and its neighbors, -1 if there is none."""
        x, y = self.x, self.y
        a, c = self.before[corner], self.after[corner]
        ax, ay, bx, by, cx, cy = x[a], y[a], x[corner], y[corner], x[c], y[c]
        low, scale = self.low, self.scale
        left, right = int((min(ax, bx, cx) - low[0]) * scale), int((max(ax, bx, cx) - low[0]) * scale)
        bottom, top = int((min(ay, by, cy) - low[1]) * scale), int((max(ay, by, cy) - low[1]) * scale)
        if (right - left + 1) * (top - bottom + 1) > MOST_CELLS:
            return self._blocker_of_all(a, corner, c)
        blocks, grid = self.blocks, self.grid
        for column in range(left, right + 1):
            for row in range(bottom, top + 1):
                for other in grid.get((column, row), ()):
                    if not blocks[other]:
                        continue
                    px, py = x[other], y[other]
                    if (
                        (bx - ax) * (py - ay) - (by - ay) * (px - ax) >= 0.0
                        and (cx - bx) * (py - by) - (cy - by) * (px - bx) >= 0.0
                        and (ax - cx) * (py - cy) - (ay - cy) * (px - cx) >= 0.0
                        # A corner that coincides with one of the ear's own does not block it, because seams of holes
                        # visit a point twice.
                        and (px, py) not in ((ax, ay), (bx, by), (cx, cy))
                    ):
                        return other
        return -1

    def _blocker_of_all(self, a: int, b: int, c: int) -> int:
        if 2 * self.open < len(self.blocking):
            # Corners that became convex need not be tested any more.
            self.blocking = self.blocking[[self.blocks[other] for other in self.blocking.tolist()]]
        inside = self.blocking[_in_triangle(self.flat[self.blocking], *self.flat[[a, b, c]])]
        return next((other for other in inside.tolist() if self.blocks[other]), -1)


def _slowly_clipped(flat: NDArray[np.float64], ring: list[int]) -> list[tuple[int, int, int]]:
    """The triangles of what is left, corner by corner; it may cross itself."""
    triangles = []
    while len(ring) > 3:
        at = _find_ear(flat, ring)
        triangles.append((ring[at - 1], ring[at], ring[(at + 1) % len(ring)]))
        del ring[at]
    triangles.append((ring[0], ring[1], ring[2]))
    return triangles


def _find_ear(flat: NDArray[np.float64], ring: list[int]) -> int:
    points = flat[ring]
    before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
    turn = _cross(points - before, after - points)
    blocking = points[turn <= 0.0]
    for at in np.flatnonzero(turn > 0.0):
        if not _in_triangle(blocking, before[at], points[at], after[at]).any():
            return int(at)
    # Flat or self-crossing: remove the flattest corner, which changes the outline least.
    return int(np.argmin(np.abs(turn)))


def _in_triangle(
    points: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Points in a triangle or on its edges, without those at its corners."""
    inside = (_cross(b - a, points - a) >= 0.0) & (_cross(c - b, points - b) >= 0.0)
    inside &= _cross(a - c, points - c) >= 0.0
    return inside & (points != a).any(axis=1) & (points != b).any(axis=1) & (points != c).any(axis=1)


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
