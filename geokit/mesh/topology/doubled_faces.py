"""Finds faces that lie back to back: the same three positions, or one flat polygon, wound in opposite directions."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.topology.connectivity import Topology, connected_components

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

# Sine of the angle within which faces lie in one plane: small quads with coordinates of six digits have it.
FLAT = 1e-3


class DoubledFaces(NamedTuple):
    """Copies of faces that lie back to back on closed components.

    Such faces cancel in a winding number. A component of faces that each count once is what the file means.

    Attributes:
        copies: Rows of the faces that repeat an earlier one, (R,), ascending.
        piece: Component of each, (R,).
        whole: Whether all faces of that component are doubled, (R,) bool.
    """

    copies: NDArray[np.int64]
    piece: NDArray[np.int32]
    whole: NDArray[np.bool_]


def none_doubled() -> DoubledFaces:
    return DoubledFaces(np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0, bool))


def back_to_back_pairs(corners: NDArray[np.int32], repeats: Indices, repeated: Indices) -> tuple[Indices, Indices]:
    """The faces with copies in both directions, and the number of pairs that each of them makes.

    Args:
        corners: Corners of the faces as numbers of positions, (F, 3).
        repeats: Faces that repeat an earlier one, from ``repeated_triples``.
        repeated: The earliest equal face of each.
    """
    one, other = corners[repeats], corners[repeated]
    alike = np.zeros(len(repeats), bool)
    for shift in range(3):
        alike |= (one == np.roll(other, shift, axis=1)).all(axis=1)
    first, group = np.unique(repeated, return_inverse=True)
    along = 1 + np.bincount(group, alike, minlength=len(first)).astype(np.int64)
    against = np.bincount(group, ~alike, minlength=len(first)).astype(np.int64)
    both = against > 0
    return first[both], np.minimum(along, against)[both]


def doubled_faces(
    corners: NDArray[np.int32], repeats: Indices, repeated: Indices, label: NDArray[np.int32], closed: NDArray[np.bool_]
) -> DoubledFaces:
    """The copies of faces that lie back to back on closed components.

    Args:
        corners: Corners of the faces, (F, 3).
        repeats: Faces that repeat an earlier one.
        repeated: The earliest equal face of each.
        label: Component of each face but the repeats, (F - R,), found without them.
        closed: Components that bound a volume, (count,).
    """
    first, _ = back_to_back_pairs(corners, repeats, repeated)
    if not len(first):
        return none_doubled()
    piece_of = np.full(len(corners), -1, np.int32)
    piece_of[np.delete(np.arange(len(corners)), repeats)] = label
    whole = np.bincount(piece_of[first], minlength=len(closed)) == np.bincount(label, minlength=len(closed))
    piece = piece_of[repeated]
    chosen = np.isin(repeated, first) & closed[piece]
    return DoubledFaces(repeats[chosen], piece[chosen], whole[piece[chosen]])


def with_polygons(
    triangles: Floats, topology: Topology, repeats: Indices, repeated: Indices
) -> tuple[Indices, Indices]:
    """Repeats, and the faces of flat polygons that are written twice, for each side, with different triangles.

    Coplanar faces that edges join are such a polygon if as many run one way as the other along each edge: what faces
    one way then covers what faces the other way.

    Args:
        triangles: Corners of the faces, (F, 3, 3).
        topology: Edges of the faces.
        repeats: Faces that repeat an earlier one, from ``repeated_triples``.
        repeated: The earliest equal face of each.
    Returns:
        The same for faces and polygons; those of a polygon repeat its other side.
    """
    if not (topology.uses > 3).any():
        return repeats, repeated
    count = len(triangles)
    edge, face = np.repeat(np.arange(topology.edge_count), topology.uses), topology.order // 3
    # Polygons of the same triangles on both sides are found already.
    plain = np.ones(count, bool)
    plain[repeats], plain[repeated] = False, False
    if not (plain[face] & (topology.uses[edge] > 3)).any():
        return repeats, repeated
    sides = triangles[:, 1:] - triangles[:, :1]
    sides /= np.maximum(np.abs(sides).max(axis=(1, 2), keepdims=True), np.finfo(float).tiny)
    normal = np.cross(sides[:, 0], sides[:, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)

    def flat(one: NDArray[Any], other: NDArray[Any]) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(np.cross(normal[one], normal[other]), axis=1) < FLAT)

    links = []
    for step in range(1, 4):
        around = np.flatnonzero(edge[step:] == edge[:-step])
        one, other = face[around], face[around + step]
        coplanar = flat(one, other)
        links.append((one[coplanar], other[coplanar]))
    group = connected_components(count, *(np.concatenate(ends) for ends in zip(*links, strict=True)))
    ahead = np.einsum("ij,ij->i", normal, normal[group]) > 0.0
    size, front = np.bincount(group, minlength=count), np.bincount(group, ahead, minlength=count)
    is_polygon = (size == 2 * front) & (front > 1)
    is_polygon[group[~flat(np.arange(count), group)]] = False
    # A boundary of nothing: on each edge the directions cancel,
    key, forward = edge * count + group[face], topology.forward[topology.order]
    _, first, number = np.unique(key, return_index=True, return_inverse=True)
    left = np.bincount(number, np.where(forward, 1, -1))
    is_polygon[group[face[first[left != 0]]]] = False
    # and each side is one layer.
    key, members = 2 * key[ahead[face]] + forward[ahead[face]], group[face[ahead[face]]]
    _, number, layers = np.unique(key, return_inverse=True, return_counts=True)
    is_polygon[members[layers[number] > 1]] = False
    # A polygon ends at other faces; one whose two sides end at each other is a thin body.
    one, other = (half // 3 for half in topology.pairs)
    is_polygon[group[one[(group[one] == group[other]) & (ahead[one] != ahead[other])]]] = False
    is_polygon &= np.bincount(group, plain, minlength=count) > 0
    kept = ~is_polygon[group[repeats]]
    rows = np.flatnonzero(is_polygon[group])
    rows = rows[np.argsort(group[rows], kind="stable")]
    back, front = rows[~ahead[rows]], rows[ahead[rows]]
    repeats, repeated = np.concatenate([repeats[kept], back]), np.concatenate([repeated[kept], front])
    order = np.argsort(repeats)
    return repeats[order], repeated[order]
