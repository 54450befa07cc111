"""Finds the closed bodies of a mesh, also where several of them meet in an edge or share a face.

Where an edge has two faces, they belong together. Where it has more, bodies touch, and the half-edges are paired: by
the vertices that the file gives each body of its own, else by angle. Between two paired faces lies the body's inside.
Where one wall stands between two solids, an edge has an odd number of faces. Then either the wall belongs to one of the
solids, or the shell around both closes without it.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.topology.connectivity import MeshTopology, Topology, connected_components, mesh_topology
from geokit.mesh.topology.measures import measure_faces
from geokit.mesh.topology.normals import unit
from geokit.mesh.topology.orientation import FLAT_SHARE

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

# Faces around an edge that are closer than this lie in one plane [radians]: they are the contact of two bodies.
SAME_ANGLE = 1e-5
# Rounds in which edges are paired; the last takes all that are left.
MOST_ROUNDS = 8


class Bodies(NamedTuple):
    """Closed bodies of a mesh.

    Attributes:
        label: Body of each face (F,) int32; -1 for the faces of none: of open sheets, of folded ones without a volume,
            and faces with two equal corners.
        volume: Signed volume of each body (B,), at unit size: negative for cavities, and for bodies inside out.
        corners: Corners of the faces as numbers of vertices of which no two bodies share one (F, 3), -1 where the label
            is.
        positions: Positions of these vertices [world] (V, 3).
    """

    label: NDArray[np.int32]
    volume: NDArray[np.float64]
    corners: NDArray[np.int32]
    positions: NDArray[np.float64]


def closed_bodies(mesh: TriangleMesh, known: MeshTopology | None = None) -> list[Bodies]:
    """The closed bodies of a mesh whose faces are wound alike.

    Where edges have faces of which not all go up in pairs, there are two readings, the one with more faces in closed
    bodies first: without the walls that lie inside of others, or with them. ``known`` is the mesh's topology, if that
    is there already.
    """
    _, _, collapsed, topology = known or mesh_topology(mesh)
    kept = np.flatnonzero(~collapsed)
    found = []
    for outermost in (False, True):
        partner = np.full(3 * len(kept), -1, np.int64)
        uneven = _find_partners(mesh, kept, topology, outermost, partner)
        found.append(_bodies(mesh, kept, partner))
        if not uneven:
            break
    return sorted(found, key=lambda bodies: -np.count_nonzero(bodies.label >= 0))


def _bodies(mesh: TriangleMesh, kept: Indices, partner: Indices) -> Bodies:
    paired = np.flatnonzero(partner >= 0)
    other = partner[paired]
    lowest = connected_components(len(kept), paired // 3, other // 3)
    alone = np.zeros(len(kept), bool)
    alone[lowest[np.flatnonzero(partner < 0) // 3]] = True
    label, volume = _solid(mesh, kept, np.where(alone[lowest], -1, lowest))

    # The corners of two paired faces at one end of their edge are one vertex: where a half-edge starts, its partner's
    # face goes on.
    following = other + 1 - (other % 3 == 2) * 3
    fan = connected_components(3 * len(kept), paired, following)
    is_first = fan == np.arange(len(fan))
    used, numbers = np.flatnonzero(is_first), np.take(np.cumsum(is_first) - 1, fan)
    corners = np.full((mesh.face_count, 3), -1, np.int32)
    corners[kept] = numbers.reshape(-1, 3)
    corners[label < 0] = -1
    return Bodies(label, volume, corners, mesh.vertices[mesh.faces[kept].reshape(-1)[used]])


def _solid(mesh: TriangleMesh, kept: Indices, lowest: NDArray[np.int32]) -> tuple[NDArray[np.int32], Floats]:
    """Numbers of the components that bound a volume for each face (F,), and their volumes."""
    closed = lowest >= 0
    names, number = np.unique(lowest[closed], return_inverse=True)
    measures = measure_faces(mesh, mesh.bounds)
    rows = kept[closed]
    volume = np.bincount(number, measures.six_volume[rows], minlength=len(names)) / 6.0
    area = np.bincount(number, measures.twice_area[rows], minlength=len(names))
    solid = np.abs(6.0 * volume) > FLAT_SHARE * area
    renumbered = np.where(solid, np.cumsum(solid) - 1, -1)
    label = np.full(mesh.face_count, -1, np.int32)
    label[rows] = renumbered[number]
    return label, volume[solid]


def _find_partners(mesh: TriangleMesh, kept: Indices, topology: Topology, outermost: bool, partner: Indices) -> bool:
    """Set the half-edge across each half-edge, (3 F,), which runs in the opposite direction.

    Returns whether there are edges of several faces that do not go up in pairs.
    """
    one, other = (pair[topology.opposed] for pair in topology.pairs)
    partner[one], partner[other] = other, one
    crowded = topology.uses > 2
    if not crowded.any():
        return False
    edge_of = np.repeat(np.arange(topology.edge_count), topology.uses)
    chosen = crowded[edge_of]
    half_edges, edges = topology.order[chosen].astype(np.int64), edge_of[chosen]

    # A file that gives bodies vertices of their own says which faces belong together.
    faces = mesh.faces[kept]
    start, end = faces.reshape(-1)[half_edges], np.roll(faces, -1, axis=1).reshape(-1)[half_edges]
    _pair_alike((np.minimum(start, end), np.maximum(start, end)), half_edges, topology, partner)
    uneven = False
    # Edges of few faces first: what they join tells more of the other edges' faces apart.
    bounds = np.unique(topology.uses[crowded])[:MOST_ROUNDS]
    for fewest, more in itertools.zip_longest(bounds, bounds[1:], fillvalue=np.iinfo(np.int64).max):
        now = (topology.uses[edges] >= fewest) & (topology.uses[edges] < more)
        joined = np.flatnonzero(partner >= 0)
        label = connected_components(len(kept), joined // 3, partner[joined] // 3)
        now &= partner[half_edges] < 0
        _pair_alike((edges[now], label[half_edges[now] // 3]), half_edges[now], topology, partner)
        now &= partner[half_edges] < 0
        uneven |= _pair_by_angle(mesh.vertices, faces, topology, half_edges[now], edges[now], outermost, partner)
    return uneven


def _pair_alike(
    keys: tuple[NDArray[Any], NDArray[Any]], half_edges: Indices, topology: Topology, partner: Indices
) -> None:
    """Pair the half-edges that are the only two with their keys, in place, if they run in opposite directions."""
    order = np.lexsort(keys)
    sorted_keys = np.stack(keys)[:, order]
    changes = np.ones(len(order), bool)
    changes[1:] = (sorted_keys[:, 1:] != sorted_keys[:, :-1]).any(axis=0)
    first = np.flatnonzero(changes)
    twos = first[np.diff(np.append(first, len(order))) == 2]
    a, b = half_edges[order[twos]], half_edges[order[twos + 1]]
    opposed = topology.forward[a] != topology.forward[b]
    partner[a[opposed]], partner[b[opposed]] = b[opposed], a[opposed]


def _pair_by_angle(
    vertices: Floats,
    faces: NDArray[np.int32],
    topology: Topology,
    half_edges: Indices,
    edges: Indices,
    outermost: bool,
    partner: Indices,
) -> bool:
    """Pair the half-edges of each edge, in place, so that the wedges between paired faces are nested.

    Seen along the edge from its lower position, a face that runs against it begins a wedge of inside, counterclockwise,
    and one that runs along it ends one. Of faces in one plane the ends come first: they are the two sides of a contact.
    Where there are more of one kind, those that are left over lie inside of a wedge if ``outermost``. Returns whether
    there were such edges.
    """
    if not len(half_edges):
        return False
    ends = topology.forward[half_edges]
    excess = np.bincount(edges, np.where(ends, 1, -1), minlength=topology.edge_count).astype(np.int64)
    angle = _angles(vertices, faces, half_edges, edges, ends)
    order = np.lexsort([angle, edges])
    new_edge = np.concatenate([[True], edges[order][1:] != edges[order][:-1]])
    step = np.concatenate([[True], np.diff(angle[order]) > SAME_ANGLE])
    plane = np.empty(len(order), np.int64)
    plane[order] = np.cumsum(new_edge | step)
    # Of whole bodies that are there twice, the first copy's faces are paired with each other.
    order = np.lexsort([np.where(ends, half_edges, -half_edges), ~ends, plane])
    half_edges, edges, ends = half_edges[order], edges[order], ends[order]
    uneven = bool(excess.any())
    while len(half_edges):
        first = np.flatnonzero(np.concatenate([[True], edges[1:] != edges[:-1]]))
        following = np.arange(1, len(edges) + 1)
        following[np.append(first[1:], len(edges)) - 1] = first
        if outermost and uneven:
            # The second of two begins in a row is inside of the first one's wedge, and so is the first of two ends.
            inner = np.where(ends, ends[following], ends == ends[np.argsort(following)]) & (
                np.where(ends, excess[edges], -excess[edges]) > 0
            )
            inner &= following != np.arange(len(edges))
            # One for each edge and round, so that no more are left out than there are too many.
            _, one = np.unique(edges[inner], return_index=True)
            dropped = np.flatnonzero(inner)[one]
            if len(dropped):
                excess[edges[dropped]] -= np.where(ends[dropped], 1, -1)
                half_edges, edges, ends = (np.delete(values, dropped) for values in (half_edges, edges, ends))
                continue
        begins = np.flatnonzero(~ends & ends[following])
        if not len(begins):
            break
        a, b = half_edges[begins], half_edges[following[begins]]
        partner[a], partner[b] = b, a
        rest = np.ones(len(edges), bool)
        rest[begins] = rest[following[begins]] = False
        half_edges, edges, ends = half_edges[rest], edges[rest], ends[rest]
    return uneven


def _angles(
    vertices: Floats, faces: NDArray[np.int32], half_edges: Indices, edges: Indices, forward: NDArray[np.bool_]
) -> Floats:
    """Angle of each half-edge's face around its edge, counterclockwise from the edge's first face."""
    face, corner = np.divmod(half_edges, 3)
    start, end, apex = (vertices[faces[face, (corner + shift) % 3]] for shift in range(3))
    low = np.where(forward[:, None], start, end)
    # At unit length, so that products neither overflow nor underflow.
    axis = unit(np.where(forward[:, None], end - start, start - end))
    side = apex - low
    side /= np.abs(side).max(axis=1, keepdims=True)
    side -= (side * axis).sum(axis=1, keepdims=True) * axis
    _, first, group = np.unique(edges, return_index=True, return_inverse=True)
    zero = side[first][group]
    angle = np.arctan2((np.cross(zero, side) * axis).sum(axis=1), (zero * side).sum(axis=1))
    # The cut lies half a tolerance before the first face, so that none of its plane is on the other side.
    return np.where(angle < -0.5 * SAME_ANGLE, angle + 2.0 * np.pi, angle)
