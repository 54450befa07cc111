"""Normals of faces and vertices from the positions."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.topology.connectivity import position_corners


def face_normals(mesh: TriangleMesh) -> NDArray[np.float64]:
    """Unit normals of the triangles, (F, 3); zero without area."""
    _, ab, ac = _edges(mesh)
    return unit(cross(ab, ac))


def vertex_normals(mesh: TriangleMesh, *, apart: bool = False) -> NDArray[np.float64]:
    """Unit normals of the vertices, (V, 3): those of the faces weighted by their angles there; zero without faces.

    Vertices at one position have one normal, but for those of bodies that touch, if they are to be kept ``apart``.

    Source:
        Thürmer and Wüthrich, "Computing vertex normals from polygonal facets" (1998).
    """
    bc, ab, ac = _edges(mesh)
    normals = unit(cross(ab, ac))
    corners, count = (mesh.faces, mesh.vertex_count) if apart else position_corners(mesh)
    # The angle at each corner between the two edges that leave it.
    leaving = ((ab, ac), (bc, -ab), (-ac, -bc))
    angles = [np.arctan2(np.linalg.norm(cross(p, q), axis=1), np.einsum("ij,ij->i", p, q)) for p, q in leaving]
    weighted = (np.stack(angles, axis=1)[..., None] * normals[:, None]).reshape(-1, 3)
    at = corners.ravel()
    sums = np.zeros((count, 3))
    for axis in range(3):
        sums[:, axis] = np.bincount(at, weighted[:, axis], minlength=count)
    position = np.zeros(mesh.vertex_count, np.int64)
    used = np.zeros(mesh.vertex_count, bool)
    position[mesh.faces.ravel()], used[mesh.faces.ravel()] = at, True
    return np.where(used[:, None], unit(sums)[position] if count else 0.0, 0.0)


def _edges(mesh: TriangleMesh) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Edges b to c, a to b and a to c, at about unit size: their products must not overflow."""
    half = float(np.max(np.abs(mesh.bounds))) if mesh.face_count else 0.0
    # A power of two does not round.
    a, b, c = (mesh.vertices[corner] * math.ldexp(1.0, -math.frexp(half)[1]) for corner in mesh.faces.T)
    return c - b, b - a, c - a


def cross(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cross products of rows, (N, 3)."""
    # Column by column: numpy.cross over rows of three is many times slower.
    (a, b, c), (x, y, z) = u.T, v.T
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=1)


def unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows (N, 3) of length 1; zero where they are zero."""
    # Scaled by the largest component first, which neither overflows nor underflows.
    largest = np.abs(vectors).max(axis=1, keepdims=True, initial=0.0)
    scaled = np.divide(vectors, largest, out=np.zeros_like(vectors), where=largest > 0.0)
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    return np.divide(scaled, length, out=scaled, where=length > 0.0)
