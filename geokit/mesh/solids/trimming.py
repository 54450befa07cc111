"""Closed meshes whose bodies cross themselves, or could not be united: faces without the parts inside of the solid.

A face that crosses others lies inside in part. It is halved until its pieces cross none, or are short; of those, each
stays that is boundary in part. So what is left of the surface reaches into the solid no farther than a piece is long.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory.needs import require_free
from geokit.mesh.attributes.derived import derived, with_data
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.sign.left_out import CONTACT, INNER_POINT
from geokit.mesh.topology.connectivity import position_corners
from geokit.mesh.topology.normals import cross, unit

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface

# Pieces at most, with their pairs: more are needed where a large part of the surface lies in one plane with another
# part, or where it is crumpled.
MOST_PIECES = 1 << 22
BYTES_PER_PIECE = 400
# Of what is left: whether it is boundary, the mesh, and the tree over it.
BYTES_PER_FACE = 300
# Pairs at a time: what is found on the way takes 1 kB each, and stays in the caches.
BLOCK = 1 << 12
# Where it is looked at whether a short piece is boundary, as weights of its corners.
PLACES = np.concatenate([INNER_POINT[None], 0.2 * INNER_POINT + 0.8 * np.eye(3)])
# Shortest pieces, in units of how far from a face its sides are looked at.
SHORTEST = 16.0


def trimmed(surface: Surface, length: float) -> tuple[TriangleMesh, NDArray[np.int64]] | None:
    """The mesh of a closed surface without what lies inside of the solid, and the row of the face in which each of its
    faces lies (F,), ascending; None if winding numbers are not whole, or too many pieces would be needed. Pieces that
    cross others have no edge beyond ``length`` [world].
    """
    mesh = surface.mesh
    off = CONTACT * float((mesh.bounds[1] - mesh.bounds[0]).max())
    if length < SHORTEST * off or not (surface.is_closed or _is_without_boundary(surface)):
        return None
    found = _pieces(mesh, surface.self_intersections(), length, off)
    if found is None:
        return None
    calm, corners, source, is_short = found
    require_free(BYTES_PER_FACE * (len(calm) + len(corners)), "what is left of crossing faces")
    whole = calm[_is_boundary(surface, mesh.vertices[mesh.faces[calm]], INNER_POINT[None], off)]
    kept = np.zeros(len(corners), bool)
    for some, places in ((~is_short, INNER_POINT[None]), (is_short, PLACES)):
        kept[some] = _is_boundary(surface, corners[some], places, off)
    pieces, rows = corners[kept], np.concatenate([whole, source[kept]])
    order = np.argsort(rows, kind="stable")
    new = mesh.vertex_count + np.arange(3 * len(pieces)).reshape(-1, 3)
    result = derived(
        with_data(mesh, vertex_data={}, corner_data={}),
        np.concatenate([mesh.vertices, pieces.reshape(-1, 3)]),
        np.concatenate([mesh.faces[whole], new])[order],
        face_source=rows[order],
    )
    return result, rows[order]


def _is_without_boundary(surface: Surface) -> bool:
    """Whether as many faces run along each edge one way as the other, so that winding numbers are whole: also where
    closed bodies share edges.
    """
    if surface._signs is not surface:
        return False
    corners, count = position_corners(surface.mesh)
    corners = np.where(surface._orientation.flipped[:, None], corners[:, ::-1], corners).astype(np.int64)
    begin, end = corners, np.roll(corners, -1, axis=1)
    _, edge = np.unique(np.minimum(begin, end) * count + np.maximum(begin, end), return_inverse=True)
    return not np.bincount(edge.reshape(-1), np.sign(end - begin).reshape(-1)).any()


def _is_boundary(
    surface: Surface, corners: NDArray[np.float64], places: NDArray[np.float64], off: float
) -> NDArray[np.bool_]:
    """Whether triangles (F, 3, 3) have the solid on one side only at one of some places: weights of their corners."""
    normals = unit(cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    found = np.zeros(len(corners), bool)
    for place in places:
        in_front, behind = (surface.winding_number(place @ corners + side * normals) > 0.5 for side in (off, -off))
        found |= in_front != behind
    return found


def _pieces(
    mesh: TriangleMesh, pairs: NDArray[np.int32], length: float, off: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]] | None:
    """Rows of faces that cross none; of all others the pieces (P, 3, 3), their faces (P,), and which of them are short
    and may still cross others (P,).
    """
    crossing, first = np.unique(pairs, return_inverse=True)
    calm = np.setdiff1d(np.arange(mesh.face_count), crossing)
    faces = mesh.vertices[mesh.faces[crossing]]
    first = first.reshape(-1, 2)
    # Rows of a piece, and of a face among those that cross, which it may cross.
    piece, other = np.concatenate([first, first[:, ::-1]]).T
    corners, source, done = faces, crossing.astype(np.int64), []
    while len(corners):
        require_free(BYTES_PER_PIECE * (len(corners) + len(piece)), "pieces of crossing faces")
        blocks = [slice(begin, begin + BLOCK) for begin in range(0, len(piece), BLOCK)]
        found = [_crosses(corners[piece[block]], faces[other[block]], off) for block in blocks]
        crosses = np.concatenate([np.zeros(0, bool), *found])
        piece, other = piece[crosses], other[crosses]
        sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        is_free = np.bincount(piece, minlength=len(corners)) == 0
        is_short = sides.max(axis=1) <= length
        ends = is_free | is_short
        done.append((corners[ends], source[ends], is_short[ends] & ~is_free[ends]))
        if sum(len(one) for one, *_ in done) + len(corners) + len(piece) > MOST_PIECES:
            return None
        # Each of the others is halved across its longest edge.
        number = np.cumsum(~ends) - 1
        goes_on = ~ends[piece]
        piece, other = number[piece[goes_on]], other[goes_on]
        corners, source = _halves(corners[~ends], sides[~ends]), np.repeat(source[~ends], 2)
        piece, other = np.concatenate([2 * piece, 2 * piece + 1]), np.tile(other, 2)
    parts = [np.concatenate(part) for part in zip(*done, strict=True)] or [faces, crossing, crossing > 0]
    return calm, parts[0], parts[1], parts[2]


def _halves(corners: NDArray[np.float64], sides: NDArray[np.float64]) -> NDArray[np.float64]:
    """Both halves of each triangle, (2 P, 3, 3)."""
    begin = sides.argmax(axis=1)
    a, b, c = (corners[np.arange(len(corners)), (begin + k) % 3] for k in range(3))
    middle = 0.5 * (a + b)
    return np.stack([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)], axis=1).reshape(-1, 3, 3)


def _crosses(a: NDArray[np.float64], b: NDArray[np.float64], off: float) -> NDArray[np.bool_]:
    """Whether triangles ``a`` may have another face's edge or plane within them: they are no farther apart than ``off``
    along any axis that could separate them, and ``a`` does not lie on ``b`` as a whole.

    Source:
        Separating axes: Gottschalk et al., "OBBTree" (1996).
    """
    a, b = a - a[:, :1], b - a[:, :1]
    edges_a, edges_b = np.roll(a, -1, axis=1) - a, np.roll(b, -1, axis=1) - b
    normal_a, normal_b = unit(cross(edges_a[:, 0], edges_a[:, 1])), unit(cross(edges_b[:, 0], edges_b[:, 1]))
    axes = [normal_a, normal_b]
    axes += [
        cross(normal, edges[:, k]) for normal, edges in ((normal_a, edges_a), (normal_b, edges_b)) for k in range(3)
    ]
    axes += [cross(edges_a[:, j], edges_b[:, k]) for j in range(3) for k in range(3)]
    meets = np.ones(len(a), bool)
    for axis in axes:
        # Of parallel edges rounding is left, which is an axis too; zero separates nothing.
        apart = off * np.linalg.norm(axis, axis=1)
        on_a, on_b = (np.einsum("pij,pj->pi", corners, axis) for corners in (a, b))
        meets &= (on_a.min(axis=1) <= on_b.max(axis=1) + apart) & (on_b.min(axis=1) <= on_a.max(axis=1) + apart)
    height = np.einsum("pij,pj->pi", a - b[:, :1], normal_b)
    covered = (np.abs(height) <= off).all(axis=1)
    for k in range(3):
        inward = unit(cross(normal_b, edges_b[:, k]))
        covered &= (np.einsum("pij,pj->pi", a - b[:, k : k + 1], inward) >= -off).all(axis=1)
    return np.asarray(meets & ~covered)
