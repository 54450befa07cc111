"""The faces to flip so that each component has one winding, solids outward and cavities inward."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.equal_rows import repeated_triples
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.topology.boxes import boxes_of
from geokit.mesh.topology.connectivity import MeshTopology, Topology, connected_components, mesh_topology
from geokit.mesh.topology.doubled_faces import DoubledFaces, doubled_faces, none_doubled, with_polygons
from geokit.mesh.topology.measures import FaceMeasures, largest_of_each, measure_faces

if TYPE_CHECKING:
    from geokit.mesh.queries.rays import RayHitLists
    from geokit.mesh.surfaces.surface import Surface

# A closed component whose volume is under this share of its area times the mesh's size is a folded sheet: its volume
# cannot be told from rounding (1e-16 for each face; the faces' errors add up like a random walk).
FLAT_SHARE = 1e-13
# Direction of the rays that determine the nesting; along no axis or diagonal, where faces often line up.
NESTING_DIRECTION = (0.5698402910, -0.3247179572, 0.7548776662)
# Above this number of components their boxes are not compared pairwise: a bool for each pair takes 4 MiB here.
MANY_PIECES = 2048
# Above this size, or below its inverse, products of three lengths leave the range of float64 in the ray test.
EXTREME_SIZE = 1e90


class FaceOrientation(NamedTuple):
    """The faces to flip.

    Attributes:
        flipped: The faces to flip, (F,) bool.
        consistent: Every component has a consistent winding; False if one of them is one-sided.
        closed: There are faces, and every edge joins exactly two of them, with the same winding after the flips.
        doubled: Faces that lie back to back with another one on a closed component.
    """

    flipped: NDArray[np.bool_]
    consistent: bool
    closed: bool
    doubled: DoubledFaces


class _Pieces(NamedTuple):
    """Components of faces joined through edges of exactly two faces.

    Attributes:
        label: Component of each face (F,), -1 for faces that are ignored.
        turned: Faces to flip for a consistent winding of their component (F,), False in one-sided components.
        piece_count: Number of components.
        one_sided: Components without a consistent winding (count,).
    """

    label: NDArray[np.int32]
    turned: NDArray[np.bool_]
    piece_count: int
    one_sided: NDArray[np.bool_]


def orient_faces(
    mesh: TriangleMesh,
    make_surface: Callable[[TriangleMesh], Surface],
    *,
    surface: Surface | None = None,
    known: MeshTopology | None = None,
) -> FaceOrientation:
    """Decide which faces :func:`geokit.mesh.orient` flips; the rules are described there.

    Args:
        mesh: The mesh; it may be empty.
        make_surface: Builds a CPU surface of a mesh, whose rays determine the nesting of components. Called only if the
            nesting matters. (Surfaces depend on this module, so it cannot import them.)
        surface: An existing surface of the mesh, or None; its rays are used instead if they are precise enough.
        known: The mesh's topology, if it has been computed.
    """
    corners, position_count, collapsed, whole = known or mesh_topology(mesh)
    kept = np.flatnonzero(~collapsed)
    flipped = np.zeros(len(mesh.faces), bool)
    if not len(kept):
        return FaceOrientation(flipped, True, False, none_doubled())
    faces = corners if len(kept) == len(corners) else corners[kept]
    topology, doubled = whole, none_doubled()
    clean = whole.only_pairs and whole.oriented
    if clean:
        pieces = _linked(len(faces), topology)
        closed = np.ones(pieces.piece_count, bool)
        first, repeats, repeated = kept, kept[:0], kept[:0]
    else:
        # Copies of a face would cut its component off from the neighbors: they flip with the face that they repeat.
        repeats, repeated = repeated_triples(faces)
        repeats, repeated = with_polygons(mesh.vertices[mesh.faces[kept]], whole, repeats, repeated)
        if len(repeats):
            topology = Topology(np.delete(faces, repeats, axis=0), position_count)
        first = np.delete(kept, repeats)
        pieces = _linked(len(first), topology) if topology.oriented else _flooded(len(first), topology)
        closed = _closed_pieces(pieces, topology)
        if len(repeats):
            doubled = doubled_faces(faces, repeats, repeated, pieces.label, closed)
            doubled = doubled._replace(copies=kept[doubled.copies])
        if not closed.all() and (whole.uses > 2).any():
            pieces, first, closed = _meeting(pieces, closed, kept, whole, repeats, repeated)
    turned = pieces.turned
    volume = _piece_volumes(measure_faces(mesh, mesh.bounds), first, pieces, closed)
    if np.any(volume < 0.0):
        turned = turned ^ _outward(mesh, first, pieces, volume, make_surface, surface)[pieces.label]
    flipped[first] = turned
    flipped[kept[repeats]] = flipped[kept[repeated]]
    consistent = not pieces.one_sided.any()
    closed_as_a_whole = whole.only_pairs and (clean or _wind_alike(whole, flipped[kept]))
    return FaceOrientation(flipped, consistent, closed_as_a_whole, doubled)


def _wind_alike(topology: Topology, flipped: NDArray[np.bool_]) -> bool:
    one, other = topology.pairs
    return bool(np.all(topology.opposed ^ flipped[one // 3] ^ flipped[other // 3]))


def _linked(face_count: int, topology: Topology) -> _Pieces:
    """Components of faces whose winding is consistent already."""
    one, other = topology.pairs
    lowest = connected_components(face_count, one // 3, other // 3)
    label, count = _numbered(lowest)
    return _Pieces(label, np.zeros(face_count, bool), count, np.zeros(count, bool))


def _flooded(face_count: int, topology: Topology) -> _Pieces:
    """Components, and the smaller set of faces to flip in each; on a tie, the set without the lowest face.

    Each face is two nodes: 2 f with its winding, and 2 f + 1 flipped. Nodes with consistent windings are linked. The
    two sides of a component are then separate, unless it is one-sided.
    """
    one, other = (pair // 3 for pair in topology.pairs)
    odd = ~topology.opposed
    links = np.concatenate([2 * one, 2 * one + 1]), np.concatenate([2 * other + odd, 2 * other + 1 - odd])
    double = connected_components(2 * face_count, *links)
    label, count = _numbered(double[::2] // 2)
    turned = double[::2] % 2 == 1
    one_sided = np.zeros(count, bool)
    one_sided[label[double[::2] == double[1::2]]] = True
    turned &= ~one_sided[label]
    against = np.bincount(label[turned], minlength=count)
    turned ^= (2 * against > np.bincount(label, minlength=count))[label]
    return _Pieces(label, turned, count, one_sided)


def _numbered(lowest: NDArray[np.int32]) -> tuple[NDArray[np.int32], int]:
    """Consecutive numbers from 0 for labels that are the lowest member of each component, in their order."""
    if len(lowest) and not lowest.any():
        return lowest, 1
    is_lowest = lowest == np.arange(len(lowest))
    number = np.cumsum(is_lowest, dtype=np.int32) - 1
    return np.take(number, lowest), int(np.count_nonzero(is_lowest))


def _closed_pieces(pieces: _Pieces, topology: Topology, has_copies: bool = False) -> NDArray[np.bool_]:
    """Components that bound a volume (count,): after the flips, each edge is used equally often in both directions."""
    closed = ~pieces.one_sided
    edge_of = np.repeat(np.arange(topology.edge_count), topology.uses)
    # Two faces at an edge cancel there, unless one is a copy of the other.
    alone = (topology.uses[edge_of] != 2) | has_copies
    half_edge = topology.order[alone]
    face = half_edge // 3
    key = edge_of[alone] * pieces.piece_count + pieces.label[face]
    balance = np.where(topology.forward[half_edge] ^ pieces.turned[face], 1, -1)
    _, first, group = np.unique(key, return_index=True, return_inverse=True)
    total = np.bincount(group, balance, minlength=len(first))
    closed[pieces.label[face[first[total != 0]]]] = False
    return closed


def _meeting(
    pieces: _Pieces,
    closed: NDArray[np.bool_],
    kept: NDArray[np.int64],
    whole: Topology,
    repeats: NDArray[np.int64],
    repeated: NDArray[np.int64],
) -> tuple[_Pieces, NDArray[np.int64], NDArray[np.bool_]]:
    """The components with those in one that only together bound a volume, such as bodies that have a wall in common.

    Copies of faces belong to these. Components that are ``closed`` alone stay as they are.

    Returns:
        The components, the rows of their faces and those that bound a volume (count,).
    """
    loose = ~closed & ~pieces.one_sided
    source = np.arange(len(kept))
    source[repeats] = repeated
    alone = np.delete(np.arange(len(kept)), repeats)
    number = np.searchsorted(alone, source)
    label, turned = pieces.label[number], pieces.turned[number]
    edge, at = np.repeat(np.arange(whole.edge_count), whole.uses), label[whole.order // 3]
    edge, at = edge[loose[at]], at[loose[at]]
    meets = edge[1:] == edge[:-1]
    group = connected_components(pieces.piece_count, at[:-1][meets], at[1:][meets])
    bound = loose & _closed_pieces(pieces._replace(label=group[label], turned=turned), whole, True)[group]
    used = bound[label]
    used[alone] = True
    label = np.where(bound, group, np.arange(pieces.piece_count))[label]
    return pieces._replace(label=label[used], turned=turned[used]), kept[used], closed | bound


def _piece_volumes(
    measures: FaceMeasures, first: NDArray[np.int64], pieces: _Pieces, closed: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Six times the signed volume of each component, (count,), at unit size; 0 for those that bound none."""
    six_volumes = measures.six_volume[first]
    six_volumes[pieces.turned] *= -1.0
    volume = np.bincount(pieces.label, six_volumes, minlength=pieces.piece_count)
    area = np.bincount(pieces.label, measures.twice_area[first], minlength=pieces.piece_count)
    return np.where(closed & (np.abs(volume) > FLAT_SHARE * area), volume, 0.0)


def _outward(
    mesh: TriangleMesh,
    first: NDArray[np.int64],
    pieces: _Pieces,
    volume: NDArray[np.float64],
    make_surface: Callable[[TriangleMesh], Surface],
    surface: Surface | None,
) -> NDArray[np.bool_]:
    """Components to flip as a whole, (count,)."""
    solid = np.flatnonzero(volume)
    inward = volume[solid] < 0.0
    index = np.full(pieces.piece_count, -1)
    index[solid] = np.arange(len(solid))
    piece = np.full(len(mesh.faces), -1)
    piece[first] = index[pieces.label]
    inner, outer = enclosing_pairs(mesh, piece, len(solid), make_surface, surface)
    depth = np.bincount(inner, minlength=len(solid))
    # The outermost component around each one; of several, which only intersecting components have, the lowest.
    root = np.full(len(solid), len(solid))
    outermost = depth[outer] == 0
    np.minimum.at(root, inner[outermost], outer[outermost])
    root = np.where(root < len(solid), root, np.arange(len(solid)))
    # +1 for outward and -1 for inward, after the outermost one faces outward and all inside it have flipped along.
    wound = np.where(inward ^ inward[root], -1, 1)
    by_depth = np.argsort(depth[inner], kind="stable")
    inner, outer = inner[by_depth], outer[by_depth]
    ends = np.searchsorted(depth[inner], np.arange(depth.max() + 2)).tolist()
    for begin, end in itertools.pairwise(ends):
        # From the outermost component inward: the winding number around each component from those that enclose it.
        # Where it is zero there is no solid that could have a cavity.
        here = np.unique(inner[begin:end])
        around = np.bincount(inner[begin:end], wound[outer[begin:end]], minlength=len(solid))[here]
        wound[here[around <= 0]] = 1
    turn = np.zeros(pieces.piece_count, bool)
    turn[solid] = inward ^ (wound < 0)
    return turn


def enclosing_pairs(
    mesh: TriangleMesh,
    piece: NDArray[Any],
    count: int,
    make_surface: Callable[[TriangleMesh], Surface],
    surface: Surface | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of closed pieces of a mesh: the second encloses the first.

    Its box contains the other's box, and a ray from the other's largest face crosses it an odd number of times.

    Args:
        mesh: The mesh.
        piece: Piece of each face (F,); -1 for the faces of none.
        count: Number of pieces; each has a face.
        make_surface: As for :func:`orient_faces`.
        surface: As for :func:`orient_faces`.
    """
    members = np.flatnonzero(piece >= 0)
    lower, upper = boxes_of(mesh.vertices, mesh.faces[members], piece[members], count)
    if not _any_box_in_another(lower, upper):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    twice_area = measure_faces(mesh, mesh.bounds).twice_area
    largest = members[largest_of_each(piece[members], twice_area[members])]
    origins = mesh.vertices[mesh.faces[largest]].mean(axis=1)
    lowest, highest = mesh.bounds
    size = float(np.max(highest * 0.5 - lowest * 0.5))
    if surface is None or not 1.0 / EXTREME_SIZE < size < EXTREME_SIZE:
        middle = lowest * 0.5 + highest * 0.5
        # Unused vertices may lie anywhere, also where this would overflow.
        local = (np.clip(mesh.vertices, lowest, highest) - middle) / size
        surface, origins = make_surface(TriangleMesh(local, mesh.faces)), (origins - middle) / size
    hits: RayHitLists = surface.raycast_all(origins, np.tile(NESTING_DIRECTION, (count, 1)))
    ray = np.repeat(np.arange(count), np.diff(hits.offsets))
    hit = piece[hits.triangle_id]
    elsewhere = (hit >= 0) & (hit != ray)
    pair, passages = np.unique(ray[elsewhere] * count + hit[elsewhere], return_counts=True)
    inner, outer = np.divmod(pair[passages % 2 == 1], count)
    held = np.all((lower[outer] <= lower[inner]) & (upper[inner] <= upper[outer]), axis=1)
    return inner[held], outer[held]


def _any_box_in_another(lower: NDArray[np.float64], upper: NDArray[np.float64]) -> bool:
    """Whether any component may enclose another, by their boxes; always True for very many components."""
    if len(lower) > MANY_PIECES:
        return True
    held = np.ones((len(lower), len(lower)), bool)
    for axis in range(3):
        held &= (lower[:, None, axis] >= lower[None, :, axis]) & (upper[:, None, axis] <= upper[None, :, axis])
    np.fill_diagonal(held, False)
    return bool(held.any())
