"""Which faces of a mesh to turn so that each piece winds alike, solids outward and cavities inward."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.equal_rows import repeated_triples
from geokit.mesh._model import TriangleMesh
from geokit.mesh.topology.connectivity import MeshTopology, Topology, connected_components, mesh_topology
from geokit.mesh.topology.measures import FaceMeasures, measure_faces

if TYPE_CHECKING:
    from geokit.mesh._surface import Surface
    from geokit.mesh.queries.rays import RayHitLists

__all__ = ["FaceOrientation", "orient_faces"]

# A closed piece whose volume is under this share of its area times the mesh's size has none that can be told from
# rounding (1e-16 for each face, and the faces' errors add up like a random walk): it is a folded sheet.
FLAT_SHARE = 1e-13
# Where the rays head that tell which piece lies in which; along no axis or diagonal, where faces like to stand in rows.
NESTING_DIRECTION = (0.5698402910, -0.3247179572, 0.7548776662)
# Boxes of more pieces than this are not compared each with each: a bool for each pair of so many is 4 MiB.
MANY_PIECES = 2048
# Beyond this size, or below its inverse, products of three lengths leave the range of float64 in the ray test.
EXTREME_SIZE = 1e90


class FaceOrientation(NamedTuple):
    """Which faces to turn.

    Attributes:
        flipped: The faces to turn, (F,) bool.
        consistent: Every piece could be made to wind alike; False where a piece is one-sided.
        closed: Every edge joins exactly two faces, and they wind alike once turned; there are faces.
    """

    flipped: NDArray[np.bool_]
    consistent: bool
    closed: bool


class _Pieces(NamedTuple):
    """Faces joined through edges of exactly two faces.

    Attributes:
        label: Number of each face's piece (F,), -1 for faces that take no part.
        turned: Faces to turn for their piece to wind alike (F,), False in one-sided pieces.
        piece_count: How many pieces there are.
        one_sided: Pieces that cannot wind alike (count,).
    """

    label: NDArray[np.int32]
    turned: NDArray[np.bool_]
    piece_count: int
    one_sided: NDArray[np.bool_]


class _Rays(NamedTuple):
    """Where rays come from: the mesh's own surface, or one that is made when needed."""

    surface: Surface | None
    make_surface: Callable[[TriangleMesh], Surface]


def orient_faces(
    mesh: TriangleMesh,
    make_surface: Callable[[TriangleMesh], Surface],
    *,
    surface: Surface | None = None,
    known: MeshTopology | None = None,
) -> FaceOrientation:
    """What :func:`geokit.mesh.orient` turns, and why: see there.

    Args:
        mesh: The mesh; it may be empty.
        make_surface: Makes a surface of a mesh, on the CPU: its rays tell which piece lies in which. Called only where
            that matters. (Surfaces are built on this module, so it does not import them.)
        surface: A surface of that mesh, if there is one; its rays are used instead where they are precise enough.
        known: The mesh's topology, if it is.
    """
    corners, position_count, collapsed, whole = known or mesh_topology(mesh)
    kept = np.flatnonzero(~collapsed)
    flipped = np.zeros(len(mesh.faces), bool)
    if not len(kept):
        return FaceOrientation(flipped, True, False)
    faces = corners if len(kept) == len(corners) else corners[kept]
    topology = whole
    clean = whole.only_pairs and whole.oriented
    if clean:
        pieces = _linked(len(faces), topology)
        closed = np.ones(pieces.piece_count, bool)
        first, repeats, repeated = kept, kept[:0], kept[:0]
    else:
        # Copies of a face would part its piece from the neighbours: they turn with the face that they repeat.
        repeats, repeated = repeated_triples(faces)
        if len(repeats):
            topology = Topology(np.delete(faces, repeats, axis=0), position_count)
        first = np.delete(kept, repeats)
        pieces = _linked(len(first), topology) if topology.oriented else _flooded(len(first), topology)
        closed = _closed_pieces(pieces, topology)
    turned = pieces.turned
    volume = _piece_volumes(measure_faces(mesh, mesh.bounds), first, pieces, closed)
    if np.any(volume < 0.0):
        turned = turned ^ _outward(mesh, first, pieces, volume, _Rays(surface, make_surface))[pieces.label]
    flipped[first] = turned
    flipped[kept[repeats]] = flipped[kept[repeated]]
    consistent = not pieces.one_sided.any()
    return FaceOrientation(flipped, consistent, whole.only_pairs and (clean or _wind_alike(whole, flipped[kept])))


def _wind_alike(topology: Topology, flipped: NDArray[np.bool_]) -> bool:
    one, other = topology.pairs
    return bool(np.all(topology.opposed ^ flipped[one // 3] ^ flipped[other // 3]))


def _linked(face_count: int, topology: Topology) -> _Pieces:
    """Pieces of faces that wind alike already."""
    one, other = topology.pairs
    lowest = connected_components(face_count, one // 3, other // 3)
    label, count = _numbered(lowest)
    return _Pieces(label, np.zeros(face_count, bool), count, np.zeros(count, bool))


def _flooded(face_count: int, topology: Topology) -> _Pieces:
    """Pieces, and in each the fewest faces to turn; those at odds with the lowest face where it is as many either way.

    Each face is there twice, as 2 f as it is and as 2 f + 1 turned, and linked to what winds as it does: the two sides
    of a piece are apart, unless it is one-sided.
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
    """Labels that are the lowest member of each component, as numbers from 0 in the order of those."""
    if len(lowest) and not lowest.any():
        return lowest, 1
    is_lowest = lowest == np.arange(len(lowest))
    number = np.cumsum(is_lowest, dtype=np.int32) - 1
    return np.take(number, lowest), int(np.count_nonzero(is_lowest))


def _closed_pieces(pieces: _Pieces, topology: Topology) -> NDArray[np.bool_]:
    """Pieces that use each of their edges as often one way as the other once turned, (count,): they bound a volume."""
    closed = ~pieces.one_sided
    edge_of = np.repeat(np.arange(topology.edge_count), topology.uses)
    alone = topology.uses[edge_of] != 2
    half_edge = topology.order[alone]
    face = half_edge // 3
    key = edge_of[alone] * pieces.piece_count + pieces.label[face]
    balance = np.where(topology.forward[half_edge] ^ pieces.turned[face], 1, -1)
    _, first, group = np.unique(key, return_index=True, return_inverse=True)
    total = np.bincount(group, balance, minlength=len(first))
    closed[pieces.label[face[first[total != 0]]]] = False
    return closed


def _piece_volumes(
    measures: FaceMeasures, first: NDArray[np.int64], pieces: _Pieces, closed: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Six times the signed volume of each piece, (count,), at unit size; 0 for pieces that bound none."""
    six_volumes = measures.six_volume[first]
    six_volumes[pieces.turned] *= -1.0
    volume = np.bincount(pieces.label, six_volumes, minlength=pieces.piece_count)
    area = np.bincount(pieces.label, measures.twice_area[first], minlength=pieces.piece_count)
    return np.where(closed & (np.abs(volume) > FLAT_SHARE * area), volume, 0.0)


def _outward(
    mesh: TriangleMesh, first: NDArray[np.int64], pieces: _Pieces, volume: NDArray[np.float64], rays: _Rays
) -> NDArray[np.bool_]:
    """Pieces to turn as a whole, (count,)."""
    solid = np.flatnonzero(volume)
    inward = volume[solid] < 0.0
    inner, outer = _nesting(mesh, first, pieces, solid, rays)
    depth = np.bincount(inner, minlength=len(solid))
    # The outermost piece around each; of several, as only pieces that intersect can have, the lowest.
    root = np.full(len(solid), len(solid))
    outermost = depth[outer] == 0
    np.minimum.at(root, inner[outermost], outer[outermost])
    root = np.where(root < len(solid), root, np.arange(len(solid)))
    # +1 outward and -1 inward, once that one faces outward and all within it have turned along.
    wound = np.where(inward ^ inward[root], -1, 1)
    by_depth = np.argsort(depth[inner], kind="stable")
    inner, outer = inner[by_depth], outer[by_depth]
    ends = np.searchsorted(depth[inner], np.arange(depth.max() + 2)).tolist()
    for begin, end in itertools.pairwise(ends):
        # From the outermost inwards: how often those around wind around each piece. Where nothing does, nothing is
        # there to have a cavity.
        here = np.unique(inner[begin:end])
        around = np.bincount(inner[begin:end], wound[outer[begin:end]], minlength=len(solid))[here]
        wound[here[around <= 0]] = 1
    turn = np.zeros(pieces.piece_count, bool)
    turn[solid] = inward ^ (wound < 0)
    return turn


def _nesting(
    mesh: TriangleMesh, first: NDArray[np.int64], pieces: _Pieces, solid: NDArray[np.int64], rays: _Rays
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of pieces, as indices into ``solid``: the second encloses the first.

    That is, its box holds the other's box, and a ray from the other's largest face leaves it an odd number of times.
    """
    index = np.full(pieces.piece_count, -1)
    index[solid] = np.arange(len(solid))
    piece = np.full(len(mesh.faces), -1)
    piece[first] = index[pieces.label]
    members = np.flatnonzero(piece >= 0)
    members = members[np.argsort(piece[members], kind="stable")]
    starts = np.searchsorted(piece[members], np.arange(len(solid)))
    corners = mesh.vertices[mesh.faces[members]]
    lower = np.minimum.reduceat(corners.min(axis=1), starts, axis=0)
    upper = np.maximum.reduceat(corners.max(axis=1), starts, axis=0)
    if not _any_box_in_another(lower, upper):
        return solid[:0], solid[:0]
    origins = corners[_largest_of_each(piece[members], corners)].mean(axis=1)
    hits = _nesting_rays(mesh, rays, origins)
    ray = np.repeat(np.arange(len(solid)), np.diff(hits.offsets))
    hit = piece[hits.triangle_id]
    elsewhere = (hit >= 0) & (hit != ray)
    pair, passages = np.unique(ray[elsewhere] * len(solid) + hit[elsewhere], return_counts=True)
    inner, outer = np.divmod(pair[passages % 2 == 1], len(solid))
    held = np.all((lower[outer] <= lower[inner]) & (upper[inner] <= upper[outer]), axis=1)
    return inner[held], outer[held]


def _nesting_rays(mesh: TriangleMesh, rays: _Rays, origins: NDArray[np.float64]) -> RayHitLists:
    surface = rays.surface
    lower, upper = mesh.bounds
    size = float(np.max(upper * 0.5 - lower * 0.5))
    if surface is None or not 1.0 / EXTREME_SIZE < size < EXTREME_SIZE:
        middle = lower * 0.5 + upper * 0.5
        # Unused vertices may lie anywhere, also where this would overflow.
        local = (np.clip(mesh.vertices, lower, upper) - middle) / size
        surface, origins = rays.make_surface(TriangleMesh(local, mesh.faces)), (origins - middle) / size
    hits: RayHitLists = surface.raycast_all(origins, np.tile(NESTING_DIRECTION, (len(origins), 1)))
    return hits


def _any_box_in_another(lower: NDArray[np.float64], upper: NDArray[np.float64]) -> bool:
    """Whether it may be worth a look which piece lies in which; of very many pieces it always is."""
    if len(lower) > MANY_PIECES:
        return True
    held = np.ones((len(lower), len(lower)), bool)
    for axis in range(3):
        held &= (lower[:, None, axis] >= lower[None, :, axis]) & (upper[:, None, axis] <= upper[None, :, axis])
    np.fill_diagonal(held, False)
    return bool(held.any())


def _largest_of_each(piece: NDArray[np.int64], corners: NDArray[np.float64]) -> NDArray[np.int64]:
    """Of the faces of each piece, which stand together, the row of the largest."""
    # At unit size: products of lengths must neither overflow nor underflow.
    size = float(np.abs(corners).max()) or 1.0
    edges = (corners[:, 1:] / size) - (corners[:, :1] / size)
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    order = np.lexsort([area, piece])
    return order[np.append(piece[1:] != piece[:-1], True)]
