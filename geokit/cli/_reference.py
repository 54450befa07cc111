"""Slow float64 answers by brute force, independent of every kernel: what the demo holds its results against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.model import TriangleMesh

__all__ = ["closest_distance", "first_hit", "neighbors_of", "trilinear"]

# Below this share of its corners' scale a determinant is rounding: the ray runs along the triangle's plane.
PARALLEL = 1e-14


def closest_distance(mesh: TriangleMesh, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance from each point to the nearest triangle, every triangle tried.

    The least of four: the plane's foot where it lies inside the triangle, and the three edges as segments.
    """
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    squared_area = np.einsum("fk,fk->f", normal, normal)
    distances = np.empty(len(points))
    for row, point in enumerate(points):
        best = min(_segment_squared(point, *edge).min() for edge in ((a, b), (b, c), (c, a)))
        inside = squared_area > 0.0
        for start, end in ((a, b), (b, c), (c, a)):
            inside &= np.einsum("fk,fk->f", np.cross(end - start, point - start), normal) >= 0.0
        if inside.any():
            height = np.einsum("fk,fk->f", point - a[inside], normal[inside])
            best = min(best, (height * height / squared_area[inside]).min())
        distances[row] = np.sqrt(best)
    return distances


def _segment_squared(
    point: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    along = end - start
    length_squared = np.einsum("fk,fk->f", along, along)
    share = np.einsum("fk,fk->f", point - start, along) / np.where(length_squared > 0.0, length_squared, 1.0)
    offset = point - start - np.clip(share, 0.0, 1.0)[:, None] * along
    return np.einsum("fk,fk->f", offset, offset)


def first_hit(mesh: TriangleMesh, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ray parameter of the first triangle that each ray meets, every triangle tried; inf for none.

    Cramer's rule for ``origin + t * direction = a + u * (b - a) + v * (c - a)``.
    """
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    side, other = b - a, c - a
    scale = np.linalg.norm(np.cross(side, other), axis=1)
    found = np.full(len(origins), np.inf)
    for row, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        across = np.cross(direction, other)
        determinant = np.einsum("fk,fk->f", side, across)
        usable = np.abs(determinant) > PARALLEL * scale * np.linalg.norm(direction)
        inverse = np.where(usable, 1.0, 0.0) / np.where(usable, determinant, 1.0)
        offset = origin - a
        u = np.einsum("fk,fk->f", offset, across) * inverse
        turned = np.cross(offset, side)
        v = (turned @ direction) * inverse
        t = np.einsum("fk,fk->f", other, turned) * inverse
        hit = usable & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t >= 0.0)
        if hit.any():
            found[row] = t[hit].min()
    return found


def neighbors_of(
    points: NDArray[np.float64], query: NDArray[np.float64], radius: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Indices, ascending, and distances of the points within ``radius`` of ``query``, every point tried."""
    offset = points - query
    squared = offset[:, 0] ** 2 + offset[:, 1] ** 2 + offset[:, 2] ** 2
    inside = np.flatnonzero(squared <= radius * radius)
    return inside, np.sqrt(squared[inside])


def trilinear(
    corners: NDArray[np.float64], fraction: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Trilinear value and index-space gradient.

    Args:
        corners: Voxel values around each point, shape (N, 2, 2, 2), axes in the order x, y, z.
        fraction: Position between them in [0, 1], shape (N, 3).
    Returns:
        Values (N,) and gradients (N, 3) per voxel.
    """
    x, y, z = (np.stack([1.0 - f, f], axis=1) for f in fraction.T)
    slope = np.array([-1.0, 1.0])
    value = np.einsum("nijk,ni,nj,nk->n", corners, x, y, z)
    gradient = np.stack(
        [
            np.einsum("nijk,i,nj,nk->n", corners, slope, y, z),
            np.einsum("nijk,ni,j,nk->n", corners, x, slope, z),
            np.einsum("nijk,ni,nj,k->n", corners, x, y, slope),
        ],
        axis=1,
    )
    return value, gradient
