"""Independent reference for mesh queries, for charts and tests: slow, simple float64 NumPy without shared code.

Nothing here traverses a tree. If a query has many candidates, bounding spheres of the triangles exclude those that
cannot be the answer; all others are computed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.accuracy.reference.points import PlaneReference, k_nearest, neighbors_within, plane_normals

__all__ = [
    "ClosestReference",
    "PlaneReference",
    "RayReference",
    "closest_point",
    "face_normals",
    "first_hit",
    "k_nearest",
    "neighbors_within",
    "plane_normals",
    "segment_parameter",
    "signed_distance",
    "winding_number",
]

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

# Rows of work at once, queries x triangles. A dozen temporaries then stay in the caches; if all of them are candidates,
# their intermediate results take 50 MB.
BLOCK = 40_000
# Queries whose winding numbers are computed at once: the data of a vertex is then read contiguously.
QUERIES = 64
# The test of a ray against a sphere takes a difference that cancels: squared distances are accurate to 1e-15 of the
# squared extent of the data, distances to 3e-8 of it. Thirty times as much is allowed.
SPHERE_MARGIN = 1e-6
# Twice the area of a triangle over the product of two edges; below it, the area is only rounding error.
NO_AREA = 4.0 * 2.0**-52


class ClosestReference(NamedTuple):
    """Closest points on a mesh.

    Attributes:
        points: The points [world], shape (N, 3).
        distance: Their distances [world], shape (N,).
        triangle_id: The lowest index among the triangles at the smallest computed distance, shape (N,).
        barycentric: Weights of the triangle's corners, shape (N, 3).
    """

    points: Floats
    distance: Floats
    triangle_id: NDArray[np.int64]
    barycentric: Floats


class RayReference(NamedTuple):
    """First hits of rays.

    Attributes:
        t: Ray parameter in units of the direction, inf for a miss, shape (N,).
        triangle_id: The lowest index among the triangles at the smallest computed t, -1 for a miss, shape (N,).
        barycentric: Weights of the triangle's corners, zero for a miss, shape (N, 3).
    """

    t: Floats
    triangle_id: NDArray[np.int64]
    barycentric: Floats


def closest_point(vertices: ArrayLike, faces: ArrayLike, queries: ArrayLike) -> ClosestReference:
    """Closest point over all triangles: the nearest of the three edges and, where it falls inside, the plane.

    Error: a few roundings of the common extent of mesh and queries
    (tests/accuracy/reference/test_mesh_points_reference.py).

    Args:
        vertices: Vertices of the mesh [world], shape (V, 3).
        faces: Their indices, shape (F, 3), at least one row.
        queries: Query points [world], shape (N, 3).
    Returns:
        ClosestReference.
    """
    corners, queries = _corners(vertices, faces), np.asarray(queries, np.float64)
    # Differences between nearby coordinates are exact, so the origin may be any nearby point. Products with powers of
    # two are exact too, and keep products of lengths in range.
    origin = corners.mean(axis=(0, 1))
    corners, moved = corners - origin, queries - origin
    exponent = _exponent(corners)
    corners, moved = np.ldexp(corners, -exponent), np.ldexp(moved, -exponent)
    centers, radii = _spheres(corners)
    result = ClosestReference(
        points=np.empty((len(queries), 3)),
        distance=np.empty(len(queries)),
        triangle_id=np.empty(len(queries), np.int64),
        barycentric=np.empty((len(queries), 3)),
    )
    for query, triangle in _batches(
        lambda rows: _near_triangles(moved[rows], centers, radii), len(moved), len(corners)
    ):
        weights = _closest_weights(corners[triangle], moved[query])
        points = _combined(weights, corners[triangle])
        distance = _length(points - moved[query])
        pick = _first_least(query, distance)
        rows = query[pick]
        result.points[rows] = np.ldexp(points[pick], exponent) + origin
        result.distance[rows] = np.ldexp(distance[pick], exponent)
        result.triangle_id[rows] = triangle[pick]
        result.barycentric[rows] = weights[pick]
    return result


def winding_number(vertices: ArrayLike, faces: ArrayLike, queries: ArrayLike) -> Floats:
    """Winding numbers (N,): sum of the triangles' signed solid angles over 4 pi; 1 inside a closed, outward mesh.

    Args:
        vertices: Vertices of the mesh [world], shape (V, 3).
        faces: Their indices, shape (F, 3).
        queries: Query points [world], shape (N, 3).
    Returns:
        Winding numbers (N,).
    Source:
        Van Oosterom and Strackee, The solid angle of a plane triangle (1983).
    """
    used, inverse = np.unique(np.asarray(faces), return_inverse=True)
    triangles: Indices = inverse.reshape(-1, 3)
    corners, queries = np.asarray(vertices, np.float64)[used], np.asarray(queries, np.float64)
    winding = np.zeros(len(queries))
    for rows in _blocks(len(queries), BLOCK // QUERIES):
        # By component and by vertex: a fraction of the time of rows of three for every corner.
        x, y, z = (corners[:, axis, None] - queries[rows, axis] for axis in range(3))
        table = x, y, z, np.sqrt(x * x + y * y + z * z)
        for some in _blocks(len(triangles), QUERIES):
            winding[rows] += _half_angles(*([values[column] for values in table] for column in triangles[some].T))
    winding /= 2.0 * np.pi
    return winding


def signed_distance(vertices: ArrayLike, faces: ArrayLike, queries: ArrayLike) -> Floats:
    """Closest distance (N,), negative where the winding number exceeds one half."""
    distance = closest_point(vertices, faces, queries).distance
    return np.where(winding_number(vertices, faces, queries) > 0.5, -distance, distance)


def first_hit(
    vertices: ArrayLike, faces: ArrayLike, origins: ArrayLike, directions: ArrayLike, max_distance: float = math.inf
) -> RayReference:
    """The hit of smallest t for each ray, (-1, inf) if there is none up to ``max_distance`` (inclusive).

    Args:
        vertices: Vertices of the mesh [world], shape (V, 3).
        faces: Their indices, shape (F, 3), at least one row.
        origins: Where rays start [world], shape (N, 3).
        directions: Their directions, of any length, shape (N, 3).
        max_distance: Length of the rays [world].
    Returns:
        RayReference.
    Source:
        Ericson, Real-Time Collision Detection (2005), 5.3.4. Differs: t is that of the triangle's plane.
    """
    corners = _corners(vertices, faces)
    origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
    center = corners.mean(axis=(0, 1))
    exponent = _exponent(corners - center)
    centers, radii = _spheres(np.ldexp(corners - center, -exponent))
    starts = np.ldexp(origins - center, -exponent)
    unit = directions / np.abs(directions).max(axis=1, keepdims=True)
    unit /= _length(unit)[:, None]
    t = np.full(len(origins), np.inf)
    triangle_id = np.full(len(origins), -1, np.int64)
    barycentric = np.zeros((len(origins), 3))
    near = _batches(lambda rows: _near_rays(starts[rows], unit[rows], centers, radii), len(starts), len(corners))
    for ray, triangle in near:
        times, weights = _crossings(corners[triangle], origins[ray], directions[ray])
        reach = times * _length(directions)[ray]
        hit = reach <= max_distance if np.isfinite(max_distance) else np.isfinite(reach)
        ray, triangle, times, weights = ray[hit], triangle[hit], times[hit], weights[hit]
        pick = _first_least(ray, times)
        rows = ray[pick]
        t[rows], triangle_id[rows], barycentric[rows] = times[pick], triangle[pick], weights[pick]
    return RayReference(t, triangle_id, barycentric)


def face_normals(vertices: ArrayLike, faces: ArrayLike) -> Floats:
    """Unit normals (F, 3) by the winding of the faces, zero where a face has no area."""
    corners = _corners(vertices, faces)
    corners = np.ldexp(corners - corners[:, :1], -_exponent(corners - corners[:, :1]))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = _length(normals)[:, None]
    return normals / np.where(length > 0.0, length, 1.0)


def segment_parameter(a: Floats, b: Floats, points: Floats) -> Floats:
    """Parameters, 0 to 1, of the points on the segments from ``a`` to ``b`` nearest to ``points``; rows of three."""
    length = _dot(b - a, b - a)
    return np.clip(_dot(points - a, b - a) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)


def _corners(vertices: ArrayLike, faces: ArrayLike) -> Floats:
    corners: Floats = np.asarray(vertices, np.float64)[np.asarray(faces)]
    return corners


def _exponent(values: Floats) -> int:
    """Exponent of the power of two that scales the values to at most 1; 0 for zeros."""
    return int(np.frexp(np.abs(values).max(initial=0.0))[1])


def _blocks(count: int, width: int) -> Iterator[slice]:
    step = max(1, BLOCK // max(width, 1))
    for first in range(0, count, step):
        yield slice(first, min(first + step, count))


def _dot(a: Floats, b: Floats) -> Floats:
    total: Floats = (a * b).sum(axis=-1)
    return total


def _length(rows: Floats) -> Floats:
    return np.asarray(np.linalg.norm(rows, axis=-1))


def _combined(weights: Floats, corners: Floats) -> Floats:
    # From one corner along two edges: if the weights do not sum to exactly 1, the point moves only within its plane.
    a = corners[..., 0, :]
    return a + (weights[..., 1:2] * (corners[..., 1, :] - a) + weights[..., 2:] * (corners[..., 2, :] - a))


def _spheres(corners: Floats) -> tuple[Floats, Floats]:
    """Centroids of triangles, and the distances of their corners from them."""
    centers = corners.mean(axis=1)
    return centers, _length(corners - centers[:, None]).max(axis=1)


def _apart(points: Floats, centers: Floats) -> tuple[Floats, Floats, Floats]:
    """Differences (Q, T) along x, y and z: a third of the time of rows of three."""
    x, y, z = (centers[:, axis] - points[:, axis, None] for axis in range(3))
    return x, y, z


def _near_triangles(points: Floats, centers: Floats, radii: Floats) -> tuple[Indices, Indices]:
    """Points and the triangles that may be nearest to them, by ascending point, then triangle."""
    x, y, z = _apart(points, centers)
    squared = x * x + y * y + z * z
    # A center lies on its triangle, and no point of the triangle is farther from it than the radius.
    reach = np.sqrt(squared.min(axis=1)) + SPHERE_MARGIN * (1.0 + _length(points))
    row, triangle = np.nonzero(squared <= (reach[:, None] + radii) ** 2)
    return row, triangle


def _near_rays(starts: Floats, unit: Floats, centers: Floats, radii: Floats) -> tuple[Indices, Indices]:
    """Rays and the triangles whose bounding sphere the ray may meet, by ascending ray, then triangle."""
    reach = radii + SPHERE_MARGIN * (1.0 + _length(starts))[:, None]
    x, y, z = _apart(starts, centers)
    along = x * unit[:, :1] + y * unit[:, 1:2] + z * unit[:, 2:]
    aside = x * x + y * y + z * z - along * along
    row, triangle = np.nonzero((aside <= reach * reach) & (along >= -reach))
    return row, triangle


def _batches(
    near: Callable[[slice], tuple[Indices, Indices]], count: int, width: int
) -> Iterator[tuple[Indices, Indices]]:
    """The results of ``near`` for blocks of rows, many blocks at once; all candidates of a row are in one batch."""
    found: list[tuple[Indices, Indices]] = []
    for rows in _blocks(count, width):
        row, triangle = near(rows)
        found.append((row + rows.start, triangle))
        if rows.stop == count or sum(len(triangles) for _, triangles in found) >= BLOCK:
            yield np.concatenate([some for some, _ in found]), np.concatenate([some for _, some in found])
            found = []


def _first_least(rows: Indices, values: Floats) -> Indices:
    """Index of the first of the least values of each row that has one; ``rows`` ascend."""
    _, starts = np.unique(rows, return_index=True)
    if not len(starts):
        return starts
    least = np.repeat(np.minimum.reduceat(values, starts), np.diff(starts, append=len(rows)))
    best = np.flatnonzero(values == least)
    return best[np.unique(rows[best], return_index=True)[1]]


def _half_angles(a: list[Floats], b: list[Floats], c: list[Floats]) -> Floats:
    """Half the solid angles of triangles, summed; x, y, z and length (T, Q) of each corner relative to the queries."""
    (ax, ay, az, la), (bx, by, bz, lb), (cx, cy, cz, lc) = a, b, c
    numerator = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    denominator = la * lb * lc
    denominator += (ax * bx + ay * by + az * bz) * lc
    denominator += (bx * cx + by * cy + bz * cz) * la
    denominator += (cx * ax + cy * ay + cz * az) * lb
    total: Floats = np.arctan2(numerator, denominator).sum(axis=0)
    return total


def _closest_weights(corners: Floats, queries: Floats) -> Floats:
    """Barycentric weights (P, 3) of the point of each triangle (P, 3, 3) that is closest to each query (P, 3)."""
    best = np.full(len(queries), np.inf)
    weights = np.zeros((len(queries), 3))
    for start, end in ((0, 1), (1, 2), (2, 0)):
        along = segment_parameter(corners[:, start], corners[:, end], queries)
        candidate = np.zeros_like(weights)
        candidate[:, start], candidate[:, end] = 1.0 - along, along
        _keep_nearer(best, weights, candidate, corners, queries)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    square = _dot(normal, normal)
    flat = square == 0.0
    # Each weight is the share of the area opposite to its corner, measured along the normal.
    candidate = np.empty_like(weights)
    for corner in range(3):
        a, b = corners[:, (corner + 1) % 3], corners[:, (corner + 2) % 3]
        candidate[:, corner] = _dot(np.cross(b - a, queries - a), normal) / np.where(flat, 1.0, square)
    inside = (candidate >= 0.0).all(axis=1) & ~flat
    candidate[~inside] = weights[~inside]
    _keep_nearer(best, weights, candidate, corners, queries)
    return weights


def _keep_nearer(best: Floats, weights: Floats, candidate: Floats, corners: Floats, queries: Floats) -> None:
    distance = _length(_combined(candidate, corners) - queries)
    nearer = distance < best
    best[nearer], weights[nearer] = distance[nearer], candidate[nearer]


def _crossings(corners: Floats, origins: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """Parameters t and weights of rays (..., 3) on triangles (..., 3, 3), inf and zero where they miss."""
    a, b, c = (corners[..., corner, :] - origins for corner in range(3))
    d = np.broadcast_to(directions, a.shape)
    # Volumes spanned by the ray's direction and each edge (Pluecker): all of one sign if the line crosses inside.
    volumes = np.stack([_dot(d, np.cross(p, q)) for p, q in ((b, c), (c, a), (a, b))], axis=-1)
    total = volumes.sum(axis=-1)
    crosses = ((volumes >= 0.0).all(axis=-1) | (volumes <= 0.0).all(axis=-1)) & (total != 0.0)
    share = volumes / np.where(total == 0.0, 1.0, total)[..., None]
    # The plane gives t to a few roundings, even from afar and on slivers, where the weights have lost digits.
    corner, normal = _planes(corners)
    slope = _dot(normal, d)
    t = _dot(normal, corner - origins) / np.where(slope == 0.0, 1.0, slope)
    hit = crosses & (slope != 0.0) & (t >= 0.0)
    return np.where(hit, t, np.inf), np.where(hit[..., None], share, 0.0)


def _planes(corners: Floats) -> tuple[Floats, Floats]:
    """A corner and a normal, not of unit length, of each triangle (..., 3, 3), from its two shortest edges.

    The normal of a triangle without area is zero.
    """
    edges = np.roll(corners, -1, axis=-2) - corners
    first = (_dot(edges, edges).argmax(axis=-1) + 2) % 3
    corner, behind, ahead = (
        np.take_along_axis(corners, ((first + k) % 3)[..., None, None], axis=-2)[..., 0, :] for k in (0, 2, 1)
    )
    normal = np.cross(ahead - corner, behind - corner)
    least = NO_AREA * _length(ahead - corner) * _length(behind - corner)
    return corner, np.where((_length(normal) > least)[..., None], normal, 0.0)
