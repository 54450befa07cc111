"""Meshes of several bodies: as files of assemblies have them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from geokit.mesh import TriangleMesh, box, merge_vertices, transform

__all__ = ["blocks", "concatenated", "in_float32", "sheet", "subdivided", "turned"]


def concatenated(*meshes: TriangleMesh) -> TriangleMesh:
    """One mesh, in which each keeps vertices of its own."""
    begins = np.cumsum([0, *(mesh.vertex_count for mesh in meshes)])
    faces = [mesh.faces + begin for mesh, begin in zip(meshes, begins, strict=False)]
    return TriangleMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def blocks(places: Sequence[Any]) -> TriangleMesh:
    """Unit cubes around places (N, 3)."""
    return concatenated(*(box(center=place) for place in places))


def turned(mesh: TriangleMesh, seed: int, offset: float = 0.0) -> TriangleMesh:
    """The mesh under a random rotation, so that planes that its bodies share differ by rounding, and moved."""
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    matrix[:3, 3] = offset
    return transform(mesh, matrix)


def in_float32(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh as a binary .stl file stores it."""
    return TriangleMesh(mesh.vertices.astype(np.float32).astype(np.float64), mesh.faces)


def sheet(height: float = 0.0, margin: float = 0.0) -> TriangleMesh:
    """A square across a unit cube, parallel to the xy plane."""
    half = 0.5 - margin
    corners = [[-half, -half, height], [half, -half, height], [half, half, height], [-half, half, height]]
    return TriangleMesh(corners, [[0, 1, 2], [0, 2, 3]])


def subdivided(mesh: TriangleMesh) -> TriangleMesh:
    """Four triangles for each, with vertices of their own in the middle of its edges."""
    corners = mesh.vertices[mesh.faces]
    middles = 0.5 * (corners + np.roll(corners, -1, axis=1))
    (a, b, c), (ab, bc, ca) = corners.transpose(1, 0, 2), middles.transpose(1, 0, 2)
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    soup = np.concatenate([np.stack(part, axis=1) for part in parts])
    return merge_vertices(TriangleMesh(soup.reshape(-1, 3), np.arange(3 * len(soup)).reshape(-1, 3)))
