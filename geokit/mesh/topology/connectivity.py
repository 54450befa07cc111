"""Connectivity of a mesh: half-edges, edges, fans around vertices, connected components.

Topology is that of positions: vertices with equal coordinates are one, and faces with two equal corners are ignored.
Half-edge ``3 f + k`` runs from corner k of face f to the next corner.
"""

from __future__ import annotations

import sys
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.equal_rows import merge_equal_points
from geokit.core.memory.host_array import HostArray
from geokit.mesh.model.triangle_mesh import TriangleMesh

# From here on, a number and an index no longer fit into 64 bits together.
PACKED_END = 2**64
# Fewest items that justify a kernel launch, and fewest that also justify loading warp.
KERNELS_PAY = 1 << 13
KERNELS_PAY_WITH_LOADING = 1 << 21
# Faces per block where many small steps are taken: the intermediate results stay in the caches.
BLOCK = 1 << 14


def position_corners(mesh: TriangleMesh) -> tuple[NDArray[np.int32], int]:
    """Corners of the faces as numbers of distinct positions, (F, 3), and the number of positions."""
    first, group = merge_equal_points(mesh.vertices)
    if len(first) == len(mesh.vertices):
        return mesh.faces, len(first)
    # take() with a flat index is several times faster than fancy indexing by rows.
    return np.take(group.astype(np.int32), mesh.faces.ravel()).reshape(-1, 3), len(first)


def collapsed_faces(corners: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Faces with two equal corners, (F,)."""
    a, b, c = corners.T
    return (a == b) | (b == c) | (c == a)


class MeshTopology(NamedTuple):
    """Connectivity of a mesh.

    Attributes:
        corners: Corners of the faces as numbers of distinct positions, (F, 3).
        position_count: Number of distinct positions of the vertices.
        collapsed: Faces with two equal corners, (F,) bool; they are ignored.
        edges: Edges of the other faces.
    """

    corners: NDArray[np.int32]
    position_count: int
    collapsed: NDArray[np.bool_]
    edges: Topology


def mesh_topology(mesh: TriangleMesh) -> MeshTopology:
    corners, position_count = position_corners(mesh)
    collapsed = collapsed_faces(corners)
    faces = corners[~collapsed] if collapsed.any() else corners
    return MeshTopology(corners, position_count, collapsed, Topology(faces, position_count))


class Topology:
    """Edges of faces (F, 3), int32, whose three corners differ; corners are numbers below ``position_count``.

    Attributes:
        order: Half-edges (3 F,), grouped by edge, ascending in each group.
        starts: Start of each edge's group in ``order`` (E,).
        uses: Number of half-edges of each edge (E,).
    """

    def __init__(self, faces: NDArray[np.int32], position_count: int) -> None:
        self.faces = np.ascontiguousarray(faces)
        self.position_count = position_count
        self.start = self.faces.reshape(-1)
        # Whether a half-edge runs from the lower position to the higher one, (3 F,).
        self.forward = np.empty(len(self.start), bool)
        edge, self.order = self._sorted_half_edges()
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
        """Number of faces at each position, (P,)."""
        return np.bincount(self.start, minlength=self.position_count)

    @cached_property
    def vertex_count(self) -> int:
        return int(np.count_nonzero(self.face_counts))

    @cached_property
    def pairs(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """The two half-edges of each edge that has exactly two."""
        if self.only_pairs:
            return self.order[::2], self.order[1::2]
        at = self.starts[self.uses == 2]
        return self.order[at], self.order[at + 1]

    @cached_property
    def opposed(self) -> NDArray[np.bool_]:
        """Whether the two half-edges of each pair run in opposite directions."""
        one, other = self.pairs
        return np.take(self.forward, one) != np.take(self.forward, other)

    @cached_property
    def oriented(self) -> bool:
        return len(self.faces) > 0 and bool(np.all(self.opposed))

    @cached_property
    def twin(self) -> NDArray[Any]:
        """The opposite half-edge of each half-edge, (3 F,); -1 if its edge does not have exactly two."""
        one, other = self.pairs
        twin = np.full(len(self.order), -1, self.order.dtype)
        twin[one], twin[other] = other, one
        return twin

    def _sorted_half_edges(self) -> tuple[NDArray[np.uint64], NDArray[Any]]:
        """The edge number of each half-edge in sorted order, and the half-edges, grouped by edge and ascending."""
        count = len(self.start)
        index = np.int32 if count <= np.iinfo(np.int32).max else np.int64
        edge = np.empty(count, np.uint64)
        # Number and index packed into one value where both fit: sorting values is three times faster than sorting
        # indices.
        packs = self.position_count * (self.position_count + 1) // 2 * count <= PACKED_END
        for begin in range(0, len(self.faces), BLOCK):
            faces = self.faces[begin : begin + BLOCK]
            rows = slice(3 * begin, 3 * begin + faces.size)
            start, end = faces.reshape(-1), faces[:, (1, 2, 0)].reshape(-1)
            self.forward[rows] = start < end
            # Pairs on and below the diagonal of a square, numbered row by row: the same for both directions.
            high = np.maximum(start, end).astype(np.uint64)
            edge[rows] = (high * (high + np.uint64(1)) >> np.uint64(1)) + np.minimum(start, end).astype(np.uint64)
            if packs:
                edge[rows] *= np.uint64(count)
                edge[rows] += np.arange(rows.start, rows.stop, dtype=np.uint64)
        if not packs:
            by_edge = np.argsort(edge, kind="stable")
            return edge[by_edge], by_edge.astype(index)
        edge.sort()
        order = np.empty(count, index)
        for begin in range(0, count, 3 * BLOCK):
            packed = edge[begin : begin + 3 * BLOCK]
            number = packed // np.uint64(count)
            order[begin : begin + 3 * BLOCK] = packed - number * np.uint64(count)
            packed[:] = number
        return edge, order

    def split_vertices(self) -> NDArray[np.int64]:
        """Positions whose faces do not form a single fan, ascending.

        A fan is a sequence of faces around the position, open or closed, joined by edges of exactly two faces each.
        """
        one, other = self.pairs
        along = next_half_edge(other)
        start, end = np.where(self.opposed, (along, other), (other, along))
        fan = connected_components(len(self.order), np.append(one, next_half_edge(one)), np.append(start, end))
        return np.flatnonzero(np.bincount(self.start[fan == np.arange(len(fan))]) > 1)

    def piece_count(self, collapsed: NDArray[np.int32]) -> int:
        """Number of components that share no position; ``collapsed`` adds those of faces with two equal corners."""
        label = self.pieces(collapsed)
        used = self.face_counts > 0
        used[collapsed] = True
        return int(np.count_nonzero(used & (label == np.arange(len(label)))))

    def pieces(self, collapsed: NDArray[np.int32]) -> NDArray[np.int32]:
        """The lowest position in each position's component, (P,); ``collapsed`` joins the corners of such faces."""
        edge = self.order[self.starts]
        one, other = np.take(self.start, edge), np.take(self.start, next_half_edge(edge))
        if len(collapsed):
            one = np.concatenate([one, collapsed[:, (0, 1)].ravel()])
            other = np.concatenate([other, collapsed[:, (1, 2)].ravel()])
        return connected_components(self.position_count, one, other)


def next_half_edge(half_edge: NDArray[Any]) -> NDArray[Any]:
    """The next half-edge of the same face, which starts where each one ends."""
    corner = half_edge - half_edge // 3 * 3
    # Corners 0 and 1 step one forward, corner 2 steps two back.
    return half_edge + 1 - (corner >> 1) * 3


def kernels_pay(item_count: int) -> bool:
    """Whether kernels beat NumPy, with the same results; loading warp takes half a second."""
    return item_count >= (KERNELS_PAY if "warp" in sys.modules else KERNELS_PAY_WITH_LOADING)


def connected_components(count: int, one: NDArray[Any], other: NDArray[Any]) -> NDArray[np.int32]:
    """The lowest node of each node's component (count,) under the links ``one[i] - other[i]``.

    Source:
        Shiloach and Vishkin, An O(log n) parallel connectivity algorithm (1982). Differs: every node hooks onto its
        lowest lower neighbor, and the resulting trees are the nodes of the next round.
    """
    if kernels_pay(len(one)):
        return _components_by_kernel(count, one, other)
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


def _components_by_kernel(count: int, one: NDArray[Any], other: NDArray[Any]) -> NDArray[np.int32]:
    from geokit.mesh.topology.components_kernels import join_kernel, lowest_kernel

    device = launcher.resolve_device("cpu")
    forest = np.arange(count, dtype=np.int32)
    links = [HostArray(np.ascontiguousarray(ends, np.int32)) for ends in (one, other)]
    launcher.launch(join_kernel, len(one), links, [HostArray(forest)], device)
    label = np.empty_like(forest)
    launcher.launch(lowest_kernel, count, [HostArray(forest)], [HostArray(label)], device)
    return label
