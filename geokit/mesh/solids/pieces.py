"""Exact unions, differences and intersections of closed bodies, by manifold3d."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.core.memory.needs import require_free
from geokit.mesh.attributes.derived import used_vertices
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.topology.normals import vertex_normals

# What becomes of solids, as manifold3d names it: of the first one all others are subtracted.
Verb = Literal["Add", "Subtract", "Intersect"]

# Memory of manifold3d for each face, with its copies.
BYTES_PER_FACE = 700
# Boxes whose pairs are looked at together.
BOXES_AT_A_TIME = 1 << 10


class Pieces(NamedTuple):
    """Faces, each with the face that it is, or lies in.

    Attributes:
        vertices: Positions [world] (V, 3).
        faces: Vertex indices (F, 3).
        source: Row of the face that each lies in (F,).
    """

    vertices: NDArray[np.float64]
    faces: NDArray[Any]
    source: NDArray[np.int64]


def pieces_of(vertices: NDArray[np.float64], faces: NDArray[Any], rows: NDArray[np.int64]) -> Pieces:
    """Some rows of faces, with the vertices that they use."""
    used, corners = used_vertices(faces[rows], len(vertices))
    return Pieces(vertices[used], corners, rows)


def together(several: Sequence[Pieces]) -> Pieces:
    """Several pieces in one, in their order."""
    begins = np.cumsum([0, *(len(each.vertices) for each in several[:-1])])
    faces = [each.faces + begin for each, begin in zip(several, begins, strict=True)]
    vertices, source = ([each[field] for each in several] for field in (0, 2))
    return Pieces(np.concatenate(vertices), np.concatenate(faces), np.concatenate(source))


def boxes_that_meet(
    lower: NDArray[np.float64], upper: NDArray[np.float64], within: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of boxes (count, 3) no farther apart than ``within`` [world], each pair once: rows of both (P,)."""
    count, lower = len(lower), lower - within
    order = np.argsort(lower[:, 0], kind="stable")
    lower, upper = lower[order], upper[order]
    ones, others = [order[:0]], [order[:0]]
    for begin in range(0, count, BOXES_AT_A_TIME):
        rows = np.arange(begin, min(begin + BOXES_AT_A_TIME, count))
        last = np.searchsorted(lower[:, 0], upper[rows, 0].max(), side="right")
        meet = np.ones((len(rows), last - begin), bool)
        for axis in range(3):
            meet &= lower[rows, None, axis] <= upper[None, begin:last, axis]
            meet &= lower[None, begin:last, axis] <= upper[rows, None, axis]
        one, other = np.nonzero(np.triu(meet, 1))
        ones.append(order[begin + one])
        others.append(order[begin + other])
    return np.concatenate(ones), np.concatenate(others)


def combined(solids: Sequence[Pieces], verb: Verb) -> Pieces | None:
    """The boundary of what solids are together, of which none may cross itself; None where manifold3d refuses one.

    A solid is a closed body and its cavities, or several that do not overlap, of which no two share a vertex.
    """
    manifold: Any = require_package("manifold3d")
    # It does not check what it allocates.
    require_free(BYTES_PER_FACE * sum(len(solid.faces) for solid in solids), "union of bodies", always=True)
    parts = []
    for solid in solids:
        # Every face keeps its number, and flat regions keep their triangles.
        made = manifold.Mesh64(solid.vertices, solid.faces.astype(np.uint64), face_id=solid.source.astype(np.uint64))
        part = manifold.Manifold(made)
        if part.status() != manifold.Error.NoError:
            return None
        parts.append(part)
    result = manifold.Manifold.batch_boolean(parts, getattr(manifold.OpType, verb))
    if result.status() != manifold.Error.NoError:
        return None
    mesh = result.to_mesh64()
    vertices = np.ascontiguousarray(mesh.vert_properties[:, :3], np.float64)
    return Pieces(vertices, mesh.tri_verts.astype(np.int64), np.asarray(mesh.face_id).astype(np.int64))


def inflated(positions: NDArray[np.float64], corners: NDArray[Any], by: float) -> NDArray[np.float64]:
    """The vertices of bodies (V, 3), moved outward by so much [world], inward if it is negative: along the mean normal
    of those faces (F, 3) whose vertices move, weighted by angle.
    """
    return positions + by * vertex_normals(TriangleMesh(positions, corners), apart=True)
