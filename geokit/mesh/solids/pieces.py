"""Exact unions, differences and intersections of closed bodies, by manifold3d."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.core.memory.needs import require_free
from geokit.mesh.attributes.derived import used_vertices
from geokit.mesh.topology.bodies import Bodies
from geokit.mesh.topology.boxes import boxes_of
from geokit.mesh.topology.connectivity import connected_components

__all__ = ["Pieces", "Solid", "Verb", "boxes_that_meet", "combined", "inflated", "solid_of"]

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
    faces: NDArray[np.int64]
    source: NDArray[np.int64]


def boxes_that_meet(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], label: NDArray[Any], count: int, within: float
) -> NDArray[np.int32]:
    """Groups of labels whose boxes are no farther apart than ``within`` [world]: the lowest label of each (count,).

    Args:
        vertices: Positions [world] (V, 3).
        faces: Vertex indices (F, 3).
        label: Label of each face (F,), from 0 to ``count``; each has a face.
        count: Number of labels.
        within: The distance [world].
    """
    lower, upper = boxes_of(vertices, faces, label, count)
    lower = lower - within
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
        one, other = np.nonzero(meet)
        ones.append(order[begin + one])
        others.append(order[begin + other])
    return connected_components(count, np.concatenate(ones), np.concatenate(others))


class Solid(NamedTuple):
    """A closed body and its cavities, or several that do not overlap.

    Attributes:
        positions: Positions [world] (V, 3).
        corners: Rows of the corners of its faces (F, 3).
        rows: Numbers of its faces (F,).
    """

    positions: NDArray[np.float64]
    corners: NDArray[Any]
    rows: NDArray[np.int64]


def solid_of(bodies: Bodies, rows: NDArray[np.int64], positions: NDArray[np.float64]) -> Solid:
    """Some faces of bodies, their vertices at these positions."""
    used, corners = used_vertices(bodies.corners[rows], len(positions))
    return Solid(positions[used], corners, rows)


def combined(solids: Sequence[Solid], verb: Verb) -> Pieces | None:
    """The boundary of what solids are together, of which none may cross itself; None where manifold3d refuses one.

    Raises:
        MissingDependencyError: manifold3d is not installed.
        DeviceMemoryError: There is not enough memory for it.
    """
    manifold: Any = require_package("manifold3d")
    # It does not check what it allocates.
    require_free(BYTES_PER_FACE * sum(len(solid.rows) for solid in solids), "union of bodies", always=True)
    parts = []
    for solid in solids:
        # Every face keeps its number, and flat regions keep their triangles.
        made = manifold.Mesh64(solid.positions, solid.corners.astype(np.uint64), face_id=solid.rows.astype(np.uint64))
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
    """The vertices of bodies, moved away from the inside [world] (V, 3): along the mean normal of their faces, weighted
    by angle.

    Args:
        positions: Vertices of the bodies [world] (V, 3).
        corners: Corners of the faces whose vertices move (F, 3).
        by: How far they move [world]; inward if it is negative.
    """
    # Not mesh.topology.normals: there, bodies that touch would share the normals of a corner.
    places = positions[corners]
    edges = np.roll(places, -1, axis=1) - places
    edges /= np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), np.finfo(float).tiny)
    normals = np.cross(edges[:, 0], edges[:, 1])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    angles = np.arccos(np.clip(-(edges * np.roll(edges, 1, axis=1)).sum(axis=2), -1.0, 1.0))
    outward = np.zeros_like(positions)
    for corner in range(3):
        np.add.at(outward, corners[:, corner], angles[:, corner, None] * normals)
    return positions + by * outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), np.finfo(float).tiny)
