"""Triangulation of the polygons of files, ear by ear, and their joining into one mesh."""

from __future__ import annotations

import itertools
from bisect import bisect_left, bisect_right
from heapq import heapify, heappop, heappush
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory.row_products import row_product
from geokit.errors import FileFormatError, InputError
from geokit.formats.attributes.joined import JoinedData
from geokit.formats.file_content.body import Body
from geokit.mesh.model.triangle_mesh import MeshPart, TriangleMesh

# Polygons of more corners are clipped all around in turn.
FEW = 64
# Corners in a leaf of the tree in which blocking corners are looked up, at most.
LEAF = 8
# Nodes of the tree that are looked at in all, for each corner: of 100,000 corners, a comb needs 25, a star 80, thorns
# 375. Then the same after the last ear, where an outline crosses itself.
LOOKS, CROSSED_LOOKS = 400, 30
# And as many more, for any outline.
FREE_LOOKS = 10_000
# Twice the area of a triangle that may be one of rounding, as a share of the square of the outline's extent.
ROUNDING = 1e-12
# A multiplier that spreads the bits of a counter (Knuth, TAOCP 6.4).
SPREAD = 2654435761


def join(bodies: list[Body], path: Path, name: str) -> TriangleMesh:
    """Join the bodies of a file into one mesh: transforms applied, polygons triangulated, names kept as parts.

    Attributes follow; a warning names those that are left out.

    Raises:
        FileFormatError: There is no polygon, a polygon has fewer than three corners, an index is out of range, or a
            vertex is not finite; the message names the file, the body and the first bad row.
    """
    if not any(len(body.counts) for body in bodies):
        held = sum(len(body.points) for body in bodies)
        what = f"holds {held} points but no faces" if held else "holds neither points nor faces"
        raise FileFormatError(f"{path}: {what}; a mesh needs faces, export the surface itself")
    vertices, faces, parts, data = [], [], [], JoinedData()
    first_vertex = first_face = 0
    for body in bodies:
        where = f"{path}, body {body.name!r}" if len(bodies) > 1 else str(path)
        points = np.asarray(body.points, np.float64)
        counts, indices = np.asarray(body.counts, np.int64), np.asarray(body.indices, np.int64)
        _check(points, counts, indices, where)
        body, points, indices = _without_unused(body, points, indices, where)
        flip = body.clockwise
        if body.transform is not None:
            linear = body.transform[:3, :3]
            # A mirroring transform turns a body inside out, so the winding is reversed.
            flip ^= bool(np.linalg.det(linear) < 0.0)
            with np.errstate(over="ignore", invalid="ignore"):
                points = row_product(points, linear.T, body.transform[:3, 3])
        corners, polygon = _triangulated(points, counts, indices)
        triangles = indices.reshape(-1, 3) if corners is None else indices[corners]
        if flip:
            triangles = triangles[:, ::-1]
        data.add(body, polygon, corners, reverse=flip)
        for part, first, count in body.groups or ((body.name, 0, len(counts)),):
            begin, end = np.searchsorted(polygon, (first, first + count))
            parts.append(MeshPart(part, first_face + int(begin), int(end - begin)))
        vertices.append(points)
        faces.append(triangles + first_vertex)
        first_vertex += len(points)
        first_face += len(triangles)
    if first_vertex > np.iinfo(np.int32).max:
        raise FileFormatError(f"{path}: {first_vertex} vertices are more than 32-bit indices reach; split the file")
    attributes = data.arguments(path)
    try:
        return TriangleMesh(
            np.concatenate(vertices),
            np.concatenate(faces),
            name=name,
            parts=tuple(parts) if len(parts) > 1 else (),
            **attributes,
        )
    except InputError as error:  # a transform that overflows
        raise FileFormatError(f"{path}: {error}") from error


def triangulate(
    points: NDArray[np.float64], counts: NDArray[np.int64], indices: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangulate polygons; the triangles keep the winding and the order of the polygons.

    A convex polygon becomes the fan from its first corner, a concave quad the fan from its reflex corner. Other concave
    polygons lose one ear after the other, on the plane of their mean (Newell) normal, so that no triangle is flipped. A
    polygon that crosses itself has no correct triangulation: where no ear is left, its flattest corner is cut off,
    until there are ``corners - 2`` triangles, whose signed areas add up to the polygon's.

    Args:
        points: Vertex positions, shape (V, 3).
        counts: Corners of each polygon, shape (P,), all >= 3.
        indices: Vertex indices of all corners, shape (sum(counts),), all in [0, V).
    Returns:
        Triangles (T, 3), and the polygon (T,) of each, ascending.
    Source:
        Meisters, Polygons have ears (1975); Newell's normal as in Sutherland et al. (1974).
    """
    corners, polygon = _triangulated(points, counts, indices)
    return indices.reshape(-1, 3) if corners is None else indices[corners], polygon


def _triangulated(
    points: NDArray[np.float64], counts: NDArray[np.int64], indices: NDArray[np.int64]
) -> tuple[NDArray[np.int64] | None, NDArray[np.int64]]:
    """:func:`triangulate`, with places in ``indices`` in place of what stands there; None where all are triangles."""
    triangle_counts = counts - 2
    polygon = np.repeat(np.arange(len(counts)), triangle_counts)
    if np.all(counts == 3):
        return None, polygon
    faces = np.empty((len(polygon), 3), np.int64)
    first_corner = np.cumsum(counts) - counts
    first_triangle = np.cumsum(triangle_counts) - triangle_counts
    for size in np.unique(counts):
        members = np.flatnonzero(counts == size)
        corners = first_corner[members][:, None] + np.arange(size)
        triangles = _fan(corners)
        if size > 3:
            turns = _turns(points[indices[corners]])
            # Rounding must not send flat corners of convex polygons to the ear clipper, which would be correct but
            # slow.
            reflex = turns < -1e-12 * np.max(np.abs(turns), axis=1, keepdims=True)
            concave = np.flatnonzero(reflex.any(axis=1))
            if size == 4:
                rolled = (np.argmin(turns[concave], axis=1)[:, None] + np.arange(4)) % 4
                triangles[concave] = _fan(np.take_along_axis(corners[concave], rolled, axis=1))
            else:
                for row in concave:
                    triangles[row] = corners[row][clip_ears(_flatten(points[indices[corners[row]]]))]
        faces[first_triangle[members][:, None] + np.arange(size - 2)] = triangles
    return faces, polygon


def _check(points: NDArray[Any], counts: NDArray[Any], indices: NDArray[Any], where: str) -> None:
    if points.ndim != 2 or points.shape[1] != 3:
        raise FileFormatError(f"{where}: points of shape {points.shape} are not (N, 3); export the file again")
    small = counts < 3
    if small.any():
        row = int(np.argmax(small))
        raise FileFormatError(f"{where}: face {row} has {counts[row]} corners; a face needs three or more, remove it")
    if counts.sum() != len(indices):
        raise FileFormatError(
            f"{where}: the faces ask for {counts.sum()} corners but {len(indices)} are there; export the file again"
        )
    outside = (indices < 0) | (indices >= len(points))
    if outside.any():
        corner = int(np.argmax(outside))
        row = int(np.searchsorted(np.cumsum(counts), corner, side="right"))
        raise FileFormatError(
            f"{where}: face {row} (counted from 0) uses vertex {indices[corner]}, but there are {len(points)} "
            "(indices counted from 0); the file is damaged, export it again"
        )


def _without_unused(
    body: Body, points: NDArray[np.float64], indices: NDArray[np.int64], where: str
) -> tuple[Body, NDArray[np.float64], NDArray[np.int64]]:
    """The body, its points and its indices without points that are not finite and that no face uses.

    Raises:
        FileFormatError: A face uses a point that is not finite.
    """
    bad = np.atleast_1d(~np.isfinite(points).all(axis=1))
    if not bad.any():
        return body, points, indices
    used = np.zeros(len(points), bool)
    used[indices] = True
    if (bad & used).any():
        row = int(np.argmax(bad & used))
        raise FileFormatError(
            f"{where}: vertex {row} (counted from 0) is not finite ({points[row].tolist()}); "
            "remove it and the faces that use it"
        )
    kept = ~bad
    note = f"vertices that are not finite and that no face uses are left out: {int(bad.sum())}, the first is vertex "
    note += str(int(np.argmax(bad)))
    vertex = {
        name: np.asarray(values)[kept] if len(values) == len(kept) else values
        for name, values in body.vertex_data.items()
    }
    body = body._replace(points=points[kept], vertex_data=vertex, notes=(*body.notes, note))
    return body, points[kept], (np.cumsum(kept) - 1)[indices]


def _fan(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Fans from the first corner: (M, n) -> (M, n - 2, 3)."""
    apex = np.broadcast_to(corners[:, :1], corners[:, 1:-1].shape)
    return np.stack([apex, corners[:, 1:-1], corners[:, 2:]], axis=2)


def _turns(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn at each corner, positive where convex, seen along the mean normal: (M, n, 3) -> (M, n)."""
    # Relative to the first corner, so that far-away polygons keep their digits; halved, since differences could
    # overflow.
    local = points * 0.5 - points[:, :1] * 0.5
    # Scaled to unit size, so that products of four lengths neither underflow nor overflow.
    size = np.max(np.abs(local), axis=(1, 2), keepdims=True)
    local = local / np.where(size > 0.0, size, 1.0)
    following = np.roll(local, -1, axis=1)
    normal = np.cross(local, following).sum(axis=1)
    into = local - np.roll(local, 1, axis=1)
    return np.einsum("mnk,mk->mn", np.cross(into, following - local), normal)


def _flatten(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project a polygon (n, 3) to the plane of its mean normal, counter-clockwise, (n, 2)."""
    local = points * 0.5 - points[0] * 0.5
    local = local / (np.max(np.abs(local)) or 1.0)
    normal = np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0)
    axis = int(np.argmax(np.abs(normal)))
    # Dropping the normal's largest axis preserves the order of corners and all inside tests.
    flat = local[:, [(axis + 1) % 3, (axis + 2) % 3]]
    return flat if normal[axis] >= 0.0 else flat * (-1.0, 1.0)


def clip_ears(flat: NDArray[np.float64]) -> list[tuple[int, int, int]]:
    """Triangulate a counter-clockwise simple polygon.

    Of few corners, the first ear is cut off at each step. Of many, ears are cut off all around in turn, so that they
    stay small. No triangle is turned over.

    A polygon that crosses itself may run out of ears. Then its flattest corner is cut off, the first of equal ones,
    also where that triangle is turned over; the signed areas of all triangles still add up to the polygon's. The time
    is n log n for any outline: after ``LOOKS`` looks for each corner nothing but the flattest corner is cut off.

    Args:
        flat: Corners, shape (n, 2).
    Returns:
        Triangles of corner indices, n - 2 of them.
    Source:
        Meisters, Polygons have ears (1975). The flattest corner: Visvalingam and Whyatt, The Cartographic Journal 30
        (1993).
    """
    return _Ring(flat).clipped()


class _Ring:
    """The corners that are left.

    An ear stays one until a neighbor goes, and a corner that something blocks needs another look only when that is cut
    off or becomes convex. So each corner is looked at a few times. Which of the corners that block it is found depends
    on the look, not on the place: else an outline could cut them off in the order in which they are found.
    """

    def __init__(self, flat: NDArray[np.float64]) -> None:
        count = len(flat)
        self.flat = flat
        self.x, self.y = flat[:, 0].tolist(), flat[:, 1].tolist()
        self.before = [count - 1, *range(count - 1)]
        self.after = [*range(1, count), 0]
        self.left, self.gone = count, [False] * count
        # Outlines with corners in a line may have nothing but these left, although they do not cross themselves.
        self.rounding = ROUNDING * float(np.ptp(flat, axis=0).max()) ** 2
        self.turn = [self._turn(corner) for corner in range(count)]
        # Only corners that are not convex can lie in an ear.
        blocks = [turn <= 0.0 for turn in self.turn]
        self.tree = _Tree(flat, np.arange(count), blocks, LOOKS * count + FREE_LOOKS)
        self.waiting: dict[int, list[int]] = {}
        # Corners that may be ears, by the number of their turn.
        self.queue, self.asked = list(range(count)), [True] * count
        self.turns = 0
        # By their turn, once there are no ears.
        self.flattest: list[tuple[float, int]] = []

    def clipped(self) -> list[tuple[int, int, int]]:
        triangles: list[tuple[int, int, int]] = []
        while self.left > 3:
            corner = self._ear()
            if corner < 0:
                corner = self._flattest()
            triangles.append((self.before[corner], corner, self.after[corner]))
            self._cut(corner)
        a, b, c = (corner for corner, gone in enumerate(self.gone) if not gone)
        return [*triangles, (a, b, c)]

    def _ear(self) -> int:
        """The next ear, -1 if there is none, or if all looks are used up."""
        queue, count = self.queue, len(self.gone)
        while queue and self.tree.looks > 0:
            corner = heappop(queue) % count
            self.asked[corner] = False
            if self.gone[corner] or not self.turn[corner] > 0.0:
                continue
            blocker = self.tree.inside(self.x, self.y, self.before[corner], corner, self.after[corner])
            if blocker < 0:
                return corner
            self.waiting.setdefault(blocker, []).append(corner)
        return -1

    def _flattest(self) -> int:
        if not self.flattest:
            self.flattest = [(abs(turn), corner) for corner, turn in enumerate(self.turn) if not self.gone[corner]]
            heapify(self.flattest)
        while True:
            size, corner = heappop(self.flattest)
            if not self.gone[corner] and size == abs(self.turn[corner]):
                if size > self.rounding:
                    self.tree.looks = min(self.tree.looks, CROSSED_LOOKS * self.left + FREE_LOOKS)
                return corner

    def _cut(self, corner: int) -> None:
        """Take a corner out, and queue those that need another look."""
        a, b = self.before[corner], self.after[corner]
        self.after[a], self.before[b] = b, a
        self.gone[corner] = True
        self.left -= 1
        self.tree.mark(corner, False)
        if 2 * self.left < self.tree.count and self.left > FEW:
            rest = np.flatnonzero(~np.array(self.gone))
            self.tree = _Tree(self.flat, rest, self.tree.marked, self.tree.looks)
        again = self.waiting.pop(corner, [])
        for near in (a, b):
            turn = self.turn[near] = self._turn(near)
            self.tree.mark(near, turn <= 0.0)
            if turn > 0.0:
                again += self.waiting.pop(near, [])
                again.append(near)
            if self.flattest:
                heappush(self.flattest, (abs(turn), near))
        count = len(self.gone)
        for one in again:
            if not self.asked[one]:
                self.asked[one] = True
                self.turns += count > FEW
                heappush(self.queue, self.turns * count + one)

    def _turn(self, corner: int) -> float:
        """Twice the signed area of the triangle of a corner and its neighbors."""
        x, y, a, c = self.x, self.y, self.before[corner], self.after[corner]
        return (x[corner] - x[a]) * (y[c] - y[corner]) - (y[corner] - y[a]) * (x[c] - x[corner])


class _Tree:
    """A binary tree of boxes over corners, with the number of marked ones below each node; node 1 is the root."""

    def __init__(self, flat: NDArray[np.float64], corners: NDArray[np.int64], marked: list[bool], looks: int) -> None:
        count = len(corners)
        self.marked, self.looks, self.count = marked, looks, count
        depth = max((count - 1) // LEAF, 0).bit_length()
        leaves, strips = 1 << depth, 1 << depth // 2
        self.leaves, self.strips = leaves, strips
        points = flat[corners]
        if depth:
            # Strips of equally many corners, and leaves along each.
            strip = np.empty(count, np.int64)
            strip[np.lexsort((points[:, 1], points[:, 0]))] = np.arange(count) * strips // count
            order = np.lexsort((points[:, 0], points[:, 1], strip))
            corners, points = corners[order], points[order]
        starts = -(np.arange(leaves) * -count // leaves)
        # Rows of leaves and boxes in one piece each, since most of the time goes into reaching them.
        rows = list(zip(corners.tolist(), *points.T.tolist(), strict=True))
        self.corners = [rows[first:last] for first, last in itertools.pairwise([*starts.tolist(), count])]
        leaf = np.zeros(len(flat), np.int64)
        leaf[corners] = leaves + np.arange(count) * leaves // count
        self.leaf: list[int] = leaf.tolist()
        boxes = [np.column_stack([np.minimum.reduceat(points, starts), -np.maximum.reduceat(points, starts)])]
        live = [np.add.reduceat(np.array(marked)[corners].astype(np.int64), starts)]
        for _ in range(depth):
            boxes.append(boxes[-1].reshape(-1, 2, 4).min(axis=1))
            live.append(live[-1].reshape(-1, 2).sum(axis=1))
        self.live: list[int] = [0, *np.concatenate(live[::-1]).tolist()]
        nodes = np.concatenate([np.zeros((1, 4)), *boxes[::-1]]) * [1.0, 1.0, -1.0, -1.0]
        self.boxes: list[list[float]] = nodes.tolist()
        # Along the strips, and along the leaves of each.
        self.low_x, self.high_x = nodes[strips : 2 * strips, [0, 2]].T.tolist()
        self.low_y, self.high_y = nodes[leaves:, [1, 3]].T.tolist()

    def mark(self, corner: int, marked: bool) -> None:
        if self.marked[corner] is marked:
            return
        self.marked[corner] = marked
        step = 1 if marked else -1
        node, live = self.leaf[corner], self.live
        while node:
            live[node] += step
            node >>= 1

    def inside(self, x: list[float], y: list[float], a: int, b: int, c: int) -> int:
        """A marked corner in a triangle or on its edges, -1 if there is none.

        One that coincides with a corner of the triangle does not count, because seams of holes visit a point twice.
        """
        live, leaves, marked = self.live, self.leaves, self.marked
        ax, ay, bx, by, cx, cy = x[a], y[a], x[b], y[b], x[c], y[c]
        left, right, bottom, top = min(ax, bx, cx), max(ax, bx, cx), min(ay, by, cy), max(ay, by, cy)
        abx, aby, bcx, bcy, cax, cay = bx - ax, by - ay, cx - bx, cy - by, ax - cx, ay - cy
        boxes = self.boxes
        # Which corner of a box (low x, low y, high x, high y) is farthest to the inner side of each edge.
        ab_x, ab_y = (0 if aby > 0.0 else 2), (3 if abx > 0.0 else 1)
        bc_x, bc_y = (0 if bcy > 0.0 else 2), (3 if bcx > 0.0 else 1)
        ca_x, ca_y = (0 if cay > 0.0 else 2), (3 if cax > 0.0 else 1)
        seed = self.looks * SPREAD
        nodes = self._start(left, right, bottom, top)
        while nodes:
            node = nodes.pop()
            if not live[node]:
                continue
            self.looks -= 1
            box = boxes[node]
            if (
                box[0] > right
                or box[2] < left
                or box[1] > top
                or box[3] < bottom
                or abx * (box[ab_y] - ay) - aby * (box[ab_x] - ax) < 0.0
                or bcx * (box[bc_y] - by) - bcy * (box[bc_x] - bx) < 0.0
                or cax * (box[ca_y] - cy) - cay * (box[ca_x] - cx) < 0.0
            ):
                continue
            if node < leaves:
                first = 2 * node + (seed >> node.bit_length() + 8 & 1)
                nodes += (first ^ 1, first)
                continue
            self.looks -= 1
            for p, px, py in self.corners[node - leaves]:
                if (
                    marked[p]
                    and abx * (py - ay) - aby * (px - ax) >= 0.0
                    and bcx * (py - by) - bcy * (px - bx) >= 0.0
                    and cax * (py - cy) - cay * (px - cx) >= 0.0
                    and (px, py) not in ((ax, ay), (bx, by), (cx, cy))
                ):
                    return p
        return -1

    def _start(self, left: float, right: float, bottom: float, top: float) -> list[int]:
        """Nodes that hold all corners in a box: of a small box some leaves, else the root."""
        size = self.leaves // self.strips
        first, last = bisect_left(self.high_x, left), bisect_right(self.low_x, right)
        if last - first > 3:
            return [1]
        nodes: list[int] = []
        for strip in range(first, last):
            leaf = strip * size
            begin = bisect_left(self.high_y, bottom, leaf, leaf + size)
            end = bisect_right(self.low_y, top, begin, leaf + size)
            nodes += range(self.leaves + begin, self.leaves + end) if end - begin < 8 else (self.strips + strip,)
        return nodes
