"""How the faces of a mesh hang together: half-edges, edges, fans around vertices, connected pieces.

Topology is that of positions: vertices at equal coordinates are one, and faces with two equal corners take no part.
Half-edge ``3 f + k`` runs from corner k of face f to the next one.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.mesh._merge import merge_equal_points
from geokit.mesh.model import TriangleMesh

__all__ = ["Topology", "collapsed_faces", "connected_components", "position_corners"]

# Rounds in which the fans of all vertices are walked at once, a face each: enough for all vertices but a few apexes,
# whose thousands of faces would take a round each. Those are left to a slower method that takes a few rounds only.
FAN_ROUNDS = 32


def position_corners(mesh: TriangleMesh) -> tuple[NDArray[np.int32], int]:
    """Corners of the faces as numbers of distinct positions, (F, 3), and how many positions the vertices have."""
    first, group = merge_equal_points(mesh.vertices)
    if len(first) == len(mesh.vertices):
        return mesh.faces, len(first)
    # take() over a flat index is several times quicker than fancy indexing by rows.
    return np.take(group.astype(np.int32), mesh.faces.ravel()).reshape(-1, 3), len(first)


def collapsed_faces(corners: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Faces with two equal corners, (F,)."""
    a, b, c = corners.T
    return (a == b) | (b == c) | (c == a)


class Topology:
    """Edges of faces (F, 3), int32, whose three corners differ; corners are numbers below ``position_count``.

    Attributes:
        order: Half-edges (3 F,), those of one edge together, ascending.
        starts: Where in ``order`` each edge begins (E,).
        uses: How many half-edges each edge has (E,).
    """

    def __init__(self, faces: NDArray[np.int32], position_count: int) -> None:
        self.faces = faces
        self.position_count = position_count
        self.start = np.ascontiguousarray(faces).ravel()
        end = np.ascontiguousarray(faces[:, (1, 2, 0)]).ravel()
        # Whether a half-edge runs from the lower position to the higher one, (3 F,).
        self.forward = self.start < end
        edge, self.order = _sorted_with_index(_edge_numbers(self.start, end), _edge_numbers_end(position_count))
        # The common case first: every edge has two half-edges.
        if len(edge) % 2 == 0 and np.array_equal(edge[::2], edge[1::2]) and np.all(edge[1:-1:2] != edge[2::2]):
            self.starts = np.arange(0, len(edge), 2)
            self.uses = np.full(len(edge) // 2, 2)
        else:
            self.starts = np.flatnonzero(np.concatenate([[True], edge[1:] != edge[:-1]]))
            self.uses = np.diff(np.append(self.starts, len(edge)))

    @property
    def edge_count(self) -> int:
        return len(self.starts)

    @cached_property
    def boundary_count(self) -> int:
        return int(np.count_nonzero(self.uses == 1))

    @cached_property
    def non_manifold_count(self) -> int:
        return int(np.count_nonzero(self.uses > 2))

    @property
    def only_pairs(self) -> bool:
        """Whether each edge has exactly two half-edges."""
        return 2 * self.edge_count == len(self.order) and self.boundary_count == 0

    @cached_property
    def face_counts(self) -> NDArray[np.int64]:
        """How many faces each position has, (P,)."""
        return np.bincount(self.start, minlength=self.position_count)

    @cached_property
    def vertex_count(self) -> int:
        return int(np.count_nonzero(self.face_counts))

    @cached_property
    def pairs(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """The two half-edges of each edge that has two."""
        if self.only_pairs:
            return self.order[::2], self.order[1::2]
        at = self.starts[self.uses == 2]
        return self.order[at], self.order[at + 1]

    @cached_property
    def opposed(self) -> NDArray[np.bool_]:
        """Of each pair, whether the two run against each other."""
        one, other = self.pairs
        return np.take(self.forward, one) != np.take(self.forward, other)

    @cached_property
    def oriented(self) -> bool:
        return len(self.faces) > 0 and bool(np.all(self.opposed))

    @cached_property
    def twin(self) -> NDArray[np.int32]:
        """The other half-edge of each one's edge, (3 F,); -1 where the edge has not exactly two."""
        one, other = self.pairs
        twin = np.full(len(self.order), -1, np.int32)
        twin[one], twin[other] = other, one
        return twin

    def split_vertices(self) -> NDArray[np.int32]:
        """Positions at which the faces do not form a single fan, ascending.

        A fan is a row of faces around the position, each meeting the next at an edge of exactly two faces, closed or
        not. All vertices are walked at once, first one way around, then from where that ended the other way.
        """
        counts = self.face_counts
        # The first half-edge from each position: with repeated indices the last assignment stands.
        first = np.full(self.position_count, -1, np.int32)
        first[self.start[::-1]] = np.arange(len(self.start) - 1, -1, -1, dtype=np.int32)
        vertex = np.flatnonzero(counts).astype(np.int32)
        seen = np.ones(self.position_count, np.int32)
        # Out of a face by the half-edge from the vertex, and where the walk ends by the one that leads to it.
        vertex, left = self._walk(vertex, first[vertex], first, seen)
        _, also_left = self._walk(vertex, _before(first[vertex]), first, seen)
        long = np.union1d(left, also_left)
        split = (counts > 0) & (seen != counts)
        split[long] = False
        return np.union1d(np.flatnonzero(split), self._split_by_components(long)).astype(np.int32)

    def _walk(
        self, vertex: NDArray[np.int32], crossed: NDArray[np.int32], first: NDArray[np.int32], seen: NDArray[np.int32]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Walks from face to face around each vertex across the half-edge ``crossed``, and counts faces in ``seen``.

        Returns the vertices whose walk came to an end at an edge, and those that were walked for too long.
        """
        ended = [vertex[:0]]
        for _ in range(FAN_ROUNDS):
            if not len(vertex):
                break
            across = np.take(self.twin, crossed)
            stopped = across < 0
            if stopped.any():
                ended.append(vertex[stopped])
                vertex, across = vertex[~stopped], across[~stopped]
            # The half-edge across starts at the vertex, or ends there: the face's other edge is the one before or after.
            starts_here = np.take(self.start, across) == vertex
            after = _after(across)
            corner = np.where(starts_here, across, after)
            onwards = corner != np.take(first, vertex)
            if not onwards.all():
                vertex, across, after = vertex[onwards], across[onwards], after[onwards]
                starts_here = starts_here[onwards]
            seen[vertex] += 1
            crossed = np.where(starts_here, _before(across), after)
        return np.concatenate(ended), vertex

    def _split_by_components(self, vertices: NDArray[np.int32]) -> NDArray[np.int64]:
        """Those of the vertices at which the faces do not form a single fan."""
        if not len(vertices):
            return np.zeros(0, np.int64)
        wanted = np.zeros(self.position_count, bool)
        wanted[vertices] = True
        one, other = self.pairs
        one_end, other_end = _after(one), _after(other)
        # Nodes are corners, numbered as the half-edge that starts there. The two faces at an edge meet at both its ends.
        links = np.where(self.opposed, other_end, other), np.where(self.opposed, other, other_end)
        here = [wanted[self.start[one]], wanted[self.start[one_end]]]
        ends = [
            np.concatenate([one[here[0]], one_end[here[1]]]),
            np.concatenate([links[0][here[0]], links[1][here[1]]]),
        ]
        corners = np.flatnonzero(wanted[self.start])
        label = connected_components(len(corners), *(np.searchsorted(corners, end) for end in ends))
        fans = np.bincount(self.start[corners[label == np.arange(len(corners))]], minlength=self.position_count)
        return np.flatnonzero(fans > 1)

    def piece_count(self, collapsed: NDArray[np.int32]) -> int:
        """Pieces that share no position; also those of faces with equal corners only, which are given apart."""
        label = self._vertex_pieces(collapsed)
        used = self.face_counts > 0
        used[collapsed] = True
        return int(np.count_nonzero(used & (label == np.arange(len(label)))))

    def _vertex_pieces(self, collapsed: NDArray[np.int32]) -> NDArray[np.int32]:
        """The lowest position of each position's piece, (P,)."""
        edge = self.order[self.starts]
        one, other = np.take(self.start, edge), np.take(self.start, _after(edge))
        if len(collapsed):
            one = np.concatenate([one, collapsed[:, (0, 1)].ravel()])
            other = np.concatenate([other, collapsed[:, (1, 2)].ravel()])
        return connected_components(self.position_count, one, other)


def _edge_numbers(start: NDArray[np.int32], end: NDArray[np.int32]) -> NDArray[np.uint64]:
    """One number for each pair of positions, whatever their order: those below the diagonal of a square, row by row."""
    high = np.maximum(start, end).astype(np.uint64)
    return (high * (high - np.uint64(1)) >> np.uint64(1)) + np.minimum(start, end).astype(np.uint64)


def _edge_numbers_end(position_count: int) -> int:
    return position_count * (position_count - 1) // 2


def _sorted_with_index(numbers: NDArray[np.uint64], end: int) -> tuple[NDArray[np.uint64], NDArray[Any]]:
    """``numbers``, all below ``end``, in ascending order, and at which index each stood; equal ones by index."""
    count = len(numbers)
    if count and end * count < 2**64:
        # Number and index in one: a sort of values is three times quicker than a sort of indices.
        packed = numbers * np.uint64(count) + np.arange(count, dtype=np.uint64)
        packed.sort()
        ordered = packed // np.uint64(count)
        return ordered, (packed - ordered * np.uint64(count)).astype(np.int32)
    order = np.argsort(numbers, kind="stable")
    return numbers[order], order.astype(np.int32) if count <= np.iinfo(np.int32).max else order


def _after(half_edge: NDArray[Any]) -> NDArray[Any]:
    return np.where(half_edge % 3 == 2, half_edge - 2, half_edge + 1)


def _before(half_edge: NDArray[Any]) -> NDArray[Any]:
    return np.where(half_edge % 3 == 0, half_edge + 2, half_edge - 1)


def connected_components(count: int, one: NDArray[Any], other: NDArray[Any]) -> NDArray[np.int32]:
    """Label (count,) of each node's component under the links ``one[i] - other[i]``: its lowest node.

    Source:
        Shiloach and Vishkin, An O(log n) parallel connectivity algorithm (1982). Differs: every node hooks onto its
        lowest lower neighbour, and the trees that come of it are the nodes of the next round.
    """
    label = np.arange(count, dtype=np.int32)
    np.minimum.at(label, np.maximum(one, other), np.minimum(one, other).astype(np.int32))
    while True:
        jumped = np.take(label, label)
        if np.array_equal(jumped, label):
            break
        label = jumped
    a, b = np.take(label, one), np.take(label, other)
    apart = a != b
    if not apart.any():
        return label
    roots = np.flatnonzero(label == np.arange(count)).astype(np.int32)
    rank = np.empty(count, np.int32)
    rank[roots] = np.arange(len(roots), dtype=np.int32)
    joined = connected_components(len(roots), np.take(rank, a[apart]), np.take(rank, b[apart]))
    return np.take(roots[joined], np.take(rank, label))
