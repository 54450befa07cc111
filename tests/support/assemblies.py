"""Meshes of several bodies: as files of assemblies have them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.mesh import TriangleMesh, box, merge_vertices, transform

__all__ = [
    "blocks",
    "concatenated",
    "in_float32",
    "prism_distance",
    "sheet",
    "star",
    "star_outline",
    "subdivided",
    "tube",
    "turned",
]


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


def star(points: int = 5, turns: int = 2, height: float = 1.0) -> TriangleMesh:
    """One closed body that crosses itself: a prism over a star polygon of radius 1 that is drawn in one stroke."""
    angles = 2.0 * np.pi * turns * np.arange(points) / points
    flat = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rings = [np.column_stack([flat, np.full(points, z)]) for z in (-0.5 * height, 0.5 * height)]
    i, last = np.arange(points), 2 * points
    j = (i + 1) % points
    walls = [[i, j, points + j], [i, points + j, points + i]]
    caps = [[0 * i + last, j, i], [0 * i + last + 1, points + i, points + j]]
    vertices = np.concatenate([*rings, [[0.0, 0.0, -0.5 * height], [0.0, 0.0, 0.5 * height]]])
    return TriangleMesh(vertices, np.stack([*walls, *caps]).transpose(0, 2, 1).reshape(-1, 3))


def star_outline(points: int = 5, turns: int = 2) -> NDArray[np.float64]:
    """The outline of the region that the star encloses (2 points, 2), counterclockwise."""
    angles = np.pi * np.arange(2 * points) / points
    inner = np.cos(np.pi * turns / points) / np.cos(np.pi * (turns - 1) / points)
    return np.where(np.arange(2 * points) % 2, inner, 1.0)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def tube(seed: int, segments: int = 60, sides: int = 20, radius: float = 0.15) -> TriangleMesh:
    """One closed body: a tube around a random closed curve in a cube of two units, which mostly crosses itself."""
    wave = np.arange(1, 4)
    phases = np.outer(2.0 * np.pi * np.arange(segments) / segments, wave)
    amplitudes = np.random.default_rng(seed).normal(size=(6, 3)) / np.tile(wave, 2)[:, None]
    middle = np.concatenate([np.cos(phases), np.sin(phases)], axis=1) @ amplitudes
    middle /= np.abs(middle).max()
    along = np.roll(middle, -1, axis=0) - np.roll(middle, 1, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # Turned no more than the curve bends; the turn that is left after a round is shared among all rings.
    first = [np.cross(along[0], [0.3, 0.5, 0.8])]
    for axis in [*along, along[0]]:
        normal = first[-1] - (first[-1] @ axis) * axis
        first.append(normal / np.linalg.norm(normal))
    rest = np.arctan2(first[-1] @ np.cross(along[0], first[1]), first[-1] @ first[1])
    normals = np.array(first[1:-1])
    angles = 2.0 * np.pi * np.arange(sides) / sides - rest * np.arange(segments)[:, None] / segments
    ring = np.cos(angles)[..., None] * normals[:, None] + np.sin(angles)[..., None] * np.cross(along, normals)[:, None]
    rows = np.arange(segments * sides).reshape(segments, sides)
    ahead, beside = np.roll(rows, -1, axis=0), np.roll(rows, -1, axis=1)
    both = np.roll(ahead, -1, axis=1)
    faces = np.concatenate(
        [np.stack(part, axis=2).reshape(-1, 3) for part in ((rows, beside, both), (rows, both, ahead))]
    )
    return TriangleMesh((middle[:, None] + radius * ring).reshape(-1, 3), faces)


def prism_distance(outline: NDArray[np.float64], height: float, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distance [world] from places (N, 3) to a prism over a counterclockwise polygon (K, 2)."""
    flat = places[:, :2]
    to_outline, inside = np.full(len(places), np.inf), np.zeros(len(places), bool)
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        along = np.clip((flat - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        to_outline = np.minimum(to_outline, np.linalg.norm(flat - a - along[:, None] * (b - a), axis=1))
        straddles = (a[1] > flat[:, 1]) != (b[1] > flat[:, 1])
        left = (b[0] - a[0]) * (flat[:, 1] - a[1]) - (b[1] - a[1]) * (flat[:, 0] - a[0]) > 0.0
        inside ^= straddles & (left == (b[1] > a[1]))
    beyond = np.stack([np.where(inside, -to_outline, to_outline), np.abs(places[:, 2]) - 0.5 * height], axis=1)
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
