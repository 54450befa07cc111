"""Slow and obviously right: float64 NumPy answers to compare geokit's with. Shares no code with geokit."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np

__all__ = [
    "ClosestReference",
    "RayReference",
    "all_ray_hits",
    "closest_on_segments",
    "closest_point",
    "common_points",
    "first_hit",
    "intersecting_pairs",
    "meet_beyond_shared",
    "neighbors_within",
    "signed_distance",
    "triangle_meets_box",
    "triangles_meet",
    "trilinear",
    "trilinear_gradient",
    "winding_number",
]

# Rows of work at once: queries x triangles stay under about 100 MB of temporaries.
_BLOCK = 400_000


class ClosestReference(NamedTuple):
    points: np.ndarray  # (N, 3)
    distance: np.ndarray  # (N,)
    triangle_id: np.ndarray  # (N,), the lowest of those at the smallest computed distance
    barycentric: np.ndarray  # (N, 3)


class RayReference(NamedTuple):
    t: np.ndarray  # (N,), inf for a miss
    triangle_id: np.ndarray  # (N,), -1 for a miss
    barycentric: np.ndarray  # (N, 3)


def _blocks(count: int, width: int):
    step = max(1, _BLOCK // max(width, 1))
    for first in range(0, count, step):
        yield slice(first, min(first + step, count))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(axis=-1)


def closest_point(vertices: np.ndarray, faces: np.ndarray, queries: np.ndarray) -> ClosestReference:
    """Closest point over all triangles: the nearest of the three edges and, where it falls inside, the plane."""
    vertices, queries = np.asarray(vertices, np.float64), np.asarray(queries, np.float64)
    # Differences between nearby coordinates are exact, so the origin may lie anywhere near.
    origin = vertices.mean(axis=0)
    corners, moved = (vertices - origin)[np.asarray(faces)], queries - origin
    result = ClosestReference(
        points=np.empty((len(queries), 3)),
        distance=np.empty(len(queries)),
        triangle_id=np.empty(len(queries), np.int64),
        barycentric=np.empty((len(queries), 3)),
    )
    for rows in _blocks(len(queries), len(corners)):
        weights = _closest_weights(corners, moved[rows])
        points = np.einsum("qtc,tck->qtk", weights, corners)
        distance = np.linalg.norm(points - moved[rows][:, None], axis=2)
        best = np.argmin(distance, axis=1)
        pick = np.arange(len(best))
        result.points[rows] = points[pick, best] + origin
        result.distance[rows] = distance[pick, best]
        result.triangle_id[rows] = best
        result.barycentric[rows] = weights[pick, best]
    return result


def _closest_weights(corners: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Barycentric weights (Q, T, 3) of the point of each triangle that is closest to each query."""
    best = np.full((len(queries), len(corners)), np.inf)
    weights = np.zeros((len(queries), len(corners), 3))
    target = queries[:, None]
    for start, end in ((0, 1), (1, 2), (2, 0)):
        a, b = corners[:, start], corners[:, end]
        along = _segment_parameter(a, b, target)
        candidate = np.zeros_like(weights)
        candidate[..., start], candidate[..., end] = 1.0 - along, along
        _keep_nearer(best, weights, candidate, corners, target)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    square = _dot(normal, normal)
    flat = square == 0.0
    # Each weight is the share of the area opposite to its corner, measured along the normal.
    candidate = np.empty_like(weights)
    for corner in range(3):
        a, b = corners[:, (corner + 1) % 3], corners[:, (corner + 2) % 3]
        candidate[..., corner] = _dot(np.cross(b - a, target - a), normal) / np.where(flat, 1.0, square)
    inside = (candidate >= 0.0).all(axis=2) & ~flat
    candidate[~inside] = weights[~inside]
    _keep_nearer(best, weights, candidate, corners, target)
    return weights


def _segment_parameter(a: np.ndarray, b: np.ndarray, points: np.ndarray) -> np.ndarray:
    length = _dot(b - a, b - a)
    return np.clip(_dot(points - a, b - a) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)


def _keep_nearer(best, weights, candidate, corners, target) -> None:
    points = np.einsum("qtc,tck->qtk", candidate, corners)
    distance = np.linalg.norm(points - target, axis=2)
    nearer = distance < best
    best[nearer], weights[nearer] = distance[nearer], candidate[nearer]


def closest_on_segments(a: np.ndarray, b: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Distance (N,) from each query to the nearest of the segments a[i] - b[i]."""
    target = np.asarray(queries, np.float64)[:, None]
    along = _segment_parameter(a, b, target)[..., None]
    return np.linalg.norm(a + along * (b - a) - target, axis=2).min(axis=1)


def winding_number(vertices: np.ndarray, faces: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Sum of the triangles' signed solid angles over 4 pi, (N,): 1 inside of a closed, outward-wound surface.

    Source:
        Van Oosterom and Strackee, The solid angle of a plane triangle (1983).
    """
    corners = np.asarray(vertices, np.float64)[np.asarray(faces)]
    queries = np.asarray(queries, np.float64)
    winding = np.empty(len(queries))
    for rows in _blocks(len(queries), len(corners)):
        a, b, c = (corners[:, corner] - queries[rows][:, None] for corner in range(3))
        la, lb, lc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
        numerator = _dot(a, np.cross(b, c))
        denominator = la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
        winding[rows] = np.arctan2(numerator, denominator).sum(axis=1) / (2.0 * np.pi)
    return winding


def signed_distance(vertices: np.ndarray, faces: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Closest distance (N,), negative where the winding number is over one half."""
    distance = closest_point(vertices, faces, queries).distance
    return np.where(winding_number(vertices, faces, queries) > 0.5, -distance, distance)


def all_ray_hits(
    vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters t (N, T), inf for a miss, and barycentric (N, T, 3) of each ray on each triangle, edges included.

    A hit is where the ray passes all three edges on the same side; t is in units of the direction's length.
    """
    corners = np.asarray(vertices, np.float64)[np.asarray(faces)]
    origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
    times = np.full((len(origins), len(corners)), np.inf)
    weights = np.zeros((len(origins), len(corners), 3))
    for rows in _blocks(len(origins), len(corners)):
        a, b, c = (corners[:, corner] - origins[rows][:, None] for corner in range(3))
        d = np.broadcast_to(directions[rows][:, None], a.shape)
        # Volumes of the ray's direction with each edge (Pluecker): all of one sign where the line crosses inside.
        volumes = np.stack([_dot(d, np.cross(p, q)) for p, q in ((b, c), (c, a), (a, b))], axis=2)
        total = volumes.sum(axis=2)
        crosses = ((volumes >= 0.0).all(axis=2) | (volumes <= 0.0).all(axis=2)) & (total != 0.0)
        share = volumes / np.where(total == 0.0, 1.0, total)[..., None]
        point = share[..., :1] * a + share[..., 1:2] * b + share[..., 2:] * c
        t = _dot(point, d) / _dot(d, d)
        hit = crosses & (t >= 0.0)
        times[rows] = np.where(hit, t, np.inf)
        weights[rows] = np.where(hit[..., None], share, 0.0)
    return times, weights


def first_hit(
    vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray, max_distance: float = np.inf
) -> RayReference:
    """The hit of smallest t for each ray, (-1, inf) where there is none up to ``max_distance`` (inclusive)."""
    times, weights = all_ray_hits(vertices, faces, origins, directions)
    best = np.argmin(times, axis=1)
    pick = np.arange(len(best))
    reach = times[pick, best] * np.linalg.norm(np.asarray(directions, np.float64), axis=1)
    hit = reach <= max_distance if np.isfinite(max_distance) else np.isfinite(reach)
    return RayReference(
        np.where(hit, times[pick, best], np.inf),
        np.where(hit, best, -1),
        np.where(hit[:, None], weights[pick, best], 0.0),
    )


def neighbors_within(points: np.ndarray, queries: np.ndarray, radius: float) -> list[np.ndarray]:
    """For each query the ascending indices of the points at a distance of at most ``radius``."""
    points = np.asarray(points, np.float64)
    return [
        np.flatnonzero(np.linalg.norm(points - query, axis=1) <= radius) for query in np.asarray(queries, np.float64)
    ]


def trilinear(values: np.ndarray, index_points: np.ndarray) -> np.ndarray:
    """Trilinear interpolation of a dense array (I, J, K) or (I, J, K, C) at index coordinates (N, 3).

    The value ``values[i, j, k]`` stands at (i, j, k); coordinates outside are clamped to the array.
    """
    values, at = np.asarray(values, np.float64), np.asarray(index_points, np.float64)
    top = np.array(values.shape[:3]) - 1
    at = np.clip(at, 0, top)
    base = np.minimum(np.floor(at).astype(int), np.maximum(top - 1, 0))
    share = at - base
    result = 0.0
    for corner in np.ndindex(2, 2, 2):
        i, j, k = np.minimum(base + corner, top).T
        weight = np.prod(np.where(corner, share, 1.0 - share), axis=1)
        result = result + values[i, j, k] * (weight if values.ndim == 3 else weight[:, None])
    return result


def trilinear_gradient(values: np.ndarray, index_points: np.ndarray) -> np.ndarray:
    """Gradient (N, 3), per index unit, of :func:`trilinear` of a scalar array (I, J, K), inside of the array."""
    values, at = np.asarray(values, np.float64), np.asarray(index_points, np.float64)
    top = np.array(values.shape) - 1
    base = np.clip(np.floor(at).astype(int), 0, top - 1)
    share = at - base
    gradient = np.zeros((len(at), 3))
    for corner in np.ndindex(2, 2, 2):
        i, j, k = (base + corner).T
        weights = np.where(corner, share, 1.0 - share)
        for axis in range(3):
            others = np.prod(np.delete(weights, axis, axis=1), axis=1)
            gradient[:, axis] += (1.0 if corner[axis] else -1.0) * others * values[i, j, k]
    return gradient


# Exact rational geometry: a polygon (a triangle, a segment, a point) clipped by the half-spaces that make up a set.


def _rational(points: np.ndarray) -> list[tuple[Fraction, ...]]:
    return [tuple(Fraction(float(x)) for x in point) for point in np.asarray(points, np.float64)]


def _minus(a: tuple, b: tuple) -> tuple:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def _rational_dot(a: tuple, b: tuple) -> Fraction:
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def _cross(a: tuple, b: tuple) -> tuple:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _clip(polygon: list, normal: tuple, point: tuple) -> list:
    """What of the polygon lies where ``normal . (x - point) >= 0``."""
    kept = []
    heights = [_rational_dot(normal, _minus(x, point)) for x in polygon]
    for k in range(len(polygon)):
        a, b, ha, hb = polygon[k - 1], polygon[k], heights[k - 1], heights[k]
        if ha * hb < 0:
            share = ha / (ha - hb)
            kept.append(tuple(x + share * (y - x) for x, y in zip(a, b, strict=True)))
        if hb >= 0:
            kept.append(b)
    return kept


def _half_spaces(triangle: list) -> list[tuple[tuple, tuple]]:
    """Normals and points of half-spaces whose intersection is the triangle, be it a segment or a point."""
    a, b, c = triangle
    normal = _cross(_minus(b, a), _minus(c, a))
    axes = [tuple(Fraction(int(i == k)) for i in range(3)) for k in range(3)]
    if any(normal):
        planes = [(normal, a), (tuple(-x for x in normal), a)]
        return planes + [(_cross(normal, _minus(q, p)), p) for p, q in ((a, b), (b, c), (c, a))]
    ends = max(((a, b), (b, c), (c, a)), key=lambda pair: _rational_dot(_minus(*pair), _minus(*pair)))
    along = _minus(ends[1], ends[0])
    around = [_cross(along, axis) for axis in axes] if any(along) else axes
    planes = [(side, ends[0]) for normal in around for side in (normal, tuple(-x for x in normal))]
    return [*planes, (along, ends[0]), (tuple(-x for x in along), ends[1])]


def common_points(t: np.ndarray, u: np.ndarray) -> list[tuple[Fraction, ...]]:
    """Corners of what two closed triangles (3, 3) have in common, exactly; empty where they do not meet."""
    polygon = _rational(t)
    for normal, point in _half_spaces(_rational(u)):
        polygon = _clip(polygon, normal, point)
    return polygon


def triangles_meet(t: np.ndarray, u: np.ndarray) -> bool:
    return bool(common_points(t, u))


def meet_beyond_shared(t: np.ndarray, u: np.ndarray) -> bool:
    """Whether two triangles meet elsewhere than on the vertex or edge whose positions they share; equal ones do."""
    corners, others = set(_rational(t)), set(_rational(u))
    if corners == others:
        return True
    shared = sorted(corners & others)
    if len(shared) == 3:
        return False
    return not all(_on_segment(x, shared) for x in common_points(t, u))


def intersecting_pairs(corners: np.ndarray, others: np.ndarray | None = None) -> list[list[int]]:
    """Pairs of triangles (N, 3, 3) that meet those of ``others``, or each other beyond what they share."""
    itself = others is None
    u = corners if itself else others
    pairs = []
    for i, t in enumerate(corners):
        near = (u.min(axis=1) <= t.max(axis=0)) & (u.max(axis=1) >= t.min(axis=0))
        for j in np.flatnonzero(near.all(axis=1)).tolist():
            if (j > i and meet_beyond_shared(t, u[j])) if itself else triangles_meet(t, u[j]):
                pairs.append([i, j])
    return pairs


def _on_segment(x: tuple, ends: list) -> bool:
    if len(ends) < 2:
        return x in ends
    along, towards = _minus(ends[1], ends[0]), _minus(x, ends[0])
    return not any(_cross(along, towards)) and 0 <= _rational_dot(along, towards) <= _rational_dot(along, along)


def triangle_meets_box(triangle: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Whether a closed triangle (3, 3) and a closed box have a common point, exactly."""
    polygon, (low, high) = _rational(triangle), _rational(np.stack([lower, upper]))
    for k in range(3):
        axis = tuple(Fraction(int(i == k)) for i in range(3))
        polygon = _clip(_clip(polygon, axis, low), tuple(-x for x in axis), high)
    return bool(polygon)


def axis_weights(order: int, t: np.ndarray, derivative: int = 0) -> np.ndarray:
    """Weights (N, 3 or 4) of the voxels at -1, 0, 1 (and 2) for a point at t, of a parabola (order 2) or a cubic (3).

    The parabola goes through the three voxels. The cubic has the values of voxels 0 and 1, and there as slopes half the
    differences of the voxels beside them, in Hermite's form.
    """
    from numpy.polynomial import Polynomial

    x = Polynomial([0.0, 1.0])
    if order == 2:
        basis = [x * (x - 1) / 2, (1 - x) * (1 + x), x * (x + 1) / 2]
    else:
        value_0, value_1 = (1 + 2 * x) * (1 - x) ** 2, x**2 * (3 - 2 * x)
        slope_0, slope_1 = x * (1 - x) ** 2, x**2 * (x - 1)
        basis = [-slope_0 / 2, value_0 - slope_1 / 2, value_1 + slope_0 / 2, slope_1 / 2]
    return np.stack([(b.deriv(derivative) if derivative else b)(t) for b in basis], axis=-1)


def tensor_interpolant(at, u: np.ndarray, order: int, derivatives: tuple[int, int, int] = (0, 0, 0)) -> np.ndarray:
    """Triquadratic (order 2) or tricubic (3) interpolant at index coordinates u (N, 3), or one of its derivatives.

    Args:
        at: Gives the values (N, ...) of voxels (N, 3).
        u: Index coordinates.
        order: 2 or 3.
        derivatives: How often to differentiate along each index axis.
    """
    base = np.floor(u)
    weights = [axis_weights(order, u[:, a] - base[:, a], derivatives[a]) for a in range(3)]
    count = order + 1
    total = 0.0
    for p, q, r in np.ndindex(count, count, count):
        value = at(base.astype(np.int64) + np.array([p - 1, q - 1, r - 1]))
        weight = weights[0][:, p] * weights[1][:, q] * weights[2][:, r]
        total = total + weight.reshape(-1, *[1] * (value.ndim - 1)) * value
    return total


def union_of_balls(points: np.ndarray, centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Least of ``|x - p| - r`` over all balls (p, r), for each of the points (N, 3)."""
    least = np.full(len(points), np.inf)
    for center, radius in zip(centers, np.broadcast_to(radii, len(centers)), strict=True):
        least = np.minimum(least, np.sqrt(((points - center) ** 2).sum(axis=1)) - radius)
    return least


def interpolant_along(at, start: np.ndarray, toward: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Trilinear interpolant at ``start + t * toward`` (index space), shape (T,).

    Args:
        at: Gives the values (N,) of voxels (N, 3).
        start: Where the ray starts.
        toward: Its direction.
        t: Where to look along it.
    """
    u = start + t[:, None] * toward
    base = np.floor(u)
    share = u - base
    total = np.zeros(len(t))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, share, 1.0 - share), axis=1)
        # A weight of zero must not make NaN of a voxel that does not count.
        total += np.where(weight == 0.0, 0.0, weight * at(base.astype(np.int64) + corner))
    return total


def borders_along(start: np.ndarray, toward: np.ndarray, first: float, last: float) -> np.ndarray:
    """Where the ray passes from cell to cell between ``first`` and ``last``, and these two, ascending."""
    found = [np.array([first, last])]
    for a in range(3):
        if toward[a] != 0.0:
            ends = sorted((start[a] + first * toward[a], start[a] + last * toward[a]))
            found.append((np.arange(np.ceil(ends[0]), np.floor(ends[1]) + 1) - start[a]) / toward[a])
    t = np.unique(np.concatenate(found))
    return t[(t >= first) & (t <= last)]


def first_level(
    at, start: np.ndarray, toward: np.ndarray, isovalue: float, first: float, last: float, fine: int = 16
) -> float:
    """First t at which the trilinear interpolant along a ray has changed its side of the isovalue; inf for none.

    Every cell is cut into ``fine`` pieces, and a piece in which the side changes into 32 pieces ten times: what touches
    the isovalue, or crosses it twice within a piece, is overlooked.
    """
    borders = borders_along(start, toward, first, last)
    share = np.arange(fine) / fine
    t = np.append((borders[:-1, None] + np.diff(borders)[:, None] * share).ravel(), borders[-1])
    for _ in range(11):
        over = interpolant_along(at, start, toward, t) > isovalue
        change = np.flatnonzero(over[:-1] != over[1:])
        if not len(change):
            return np.inf
        t = np.linspace(t[change[0]], t[change[0] + 1], 33)
    return t[-1]


def optical_depth(at, start: np.ndarray, toward: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Integral over t of the trilinear interpolant from ``t[0]`` to each of ``t``, which contains all cell borders.

    Boole's rule: exact for the cubic that the interpolant is between two of them.
    """
    steps = np.diff(t)
    share = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    weight = np.array([7.0, 32.0, 12.0, 32.0, 7.0]) / 90.0
    inner = (t[:-1, None] + steps[:, None] * share).ravel()
    # The ends of a cell are values of the cell itself: the interpolant is continuous.
    value = interpolant_along(at, start, toward, inner).reshape(-1, 5)
    return np.concatenate([[0.0], np.cumsum(steps * (value @ weight))])


def farthest_point_order(points: np.ndarray, count: int, start: int) -> np.ndarray:
    """Greedy farthest point sampling; ties go to the lowest index, and none is taken twice."""
    least = np.full(len(points), np.inf)
    taken = [start]
    while len(taken) < count:
        d = points - points[taken[-1]]
        least = np.minimum(least, (d[:, 0] ** 2 + d[:, 1] ** 2) + d[:, 2] ** 2)
        least[taken[-1]] = -1.0
        taken.append(int(np.argmax(least)))
    return np.array(taken)


def poisson_disk_indices(points: np.ndarray, radius: float, seed: int) -> np.ndarray:
    """Points tried in random order, taken where none taken before is nearer than the radius; ascending."""
    taken: list[int] = []
    for i in np.random.default_rng(seed).permutation(len(points)):
        d = points[taken] - points[i]
        if not ((d[:, 0] ** 2 + d[:, 1] ** 2) + d[:, 2] ** 2 < radius * radius).any():
            taken.append(int(i))
    return np.sort(taken)


def voxel_means(points: np.ndarray, voxel_size: float) -> tuple[np.ndarray, np.ndarray]:
    """Centroids of the occupied voxels by ascending (z, y, x), exactly summed, and the point nearest to each."""
    members: dict[tuple[float, ...], list[int]] = {}
    for i, cell in enumerate(np.floor(points / voxel_size)[:, ::-1].tolist()):
        members.setdefault(tuple(cell), []).append(i)
    centroids, nearest = [], []
    for cell in sorted(members):
        rows = _rational(points[members[cell]])
        mean = tuple(sum(column) / len(rows) for column in zip(*rows, strict=True))
        centroids.append([float(x) for x in mean])
        squared = [_rational_dot(d, d) for d in (_minus(row, mean) for row in rows)]
        nearest.append(members[cell][squared.index(min(squared))])
    return np.array(centroids), np.array(nearest)


def register_by_numpy(
    source: np.ndarray, target: np.ndarray, normals: np.ndarray, method: str, max_distance: float, steps: int
) -> tuple[np.ndarray, float, float]:
    """Iterative closest points in world coordinates with all pairs and least squares; transform, rmse, fitness."""
    transform = np.eye(4)
    for step in range(steps + 1):
        points = source @ transform[:3, :3].T + transform[:3, 3]
        squared = ((points[:, None] - target[None]) ** 2).sum(axis=2)
        partner = squared.argmin(axis=1)
        near = np.sqrt(squared.min(axis=1)) <= max_distance
        p, q, n = points[near], target[partner[near]], normals[partner[near]]
        if step == steps:
            break
        move = np.eye(4)
        if method == "point_to_plane":
            system = np.concatenate([np.cross(p - p.mean(axis=0), n), n], axis=1)
            x = np.linalg.lstsq(system, ((q - p) * n).sum(axis=1), rcond=None)[0]
            angle = np.linalg.norm(x[:3])
            # The rotation about a vector is the quaternion (cos, sin * axis) of half its length.
            w, v = np.cos(angle / 2), np.sin(angle / 2) * x[:3] / angle
            cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
            move[:3, :3] = np.eye(3) + 2 * w * cross + 2 * cross @ cross
            # The step is one about the source's own centroid: so is the reference's.
            centre = points.mean(axis=0)
            shift = x[3:] + np.cross(x[:3], centre - p.mean(axis=0))
            move[:3, 3] = centre + shift - move[:3, :3] @ centre
        else:
            u, _, vt = np.linalg.svd((p - p.mean(axis=0)).T @ (q - q.mean(axis=0)))
            move[:3, :3] = vt.T @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ u.T
            move[:3, 3] = q.mean(axis=0) - move[:3, :3] @ p.mean(axis=0)
        transform = move @ transform
    return transform, float(np.sqrt(((p - q) ** 2).sum(axis=1).mean())), float(near.mean())


def density_clusters(points: np.ndarray, radius: float, minimum_count: int) -> np.ndarray:
    """DBSCAN by the matrix of all squared distances and a flood from each lowest core point; -1 is noise."""
    d = points[:, None] - points[None]
    squared = (d[..., 0] ** 2 + d[..., 1] ** 2) + d[..., 2] ** 2
    near = squared <= radius * radius
    core = near.sum(axis=1) >= minimum_count
    labels = np.full(len(points), -1)
    cluster_count = 0
    for first in np.flatnonzero(core):
        if labels[first] >= 0:
            continue
        front = [first]
        labels[first] = cluster_count
        while front:
            for j in np.flatnonzero(near[front.pop()] & core & (labels < 0)):
                labels[j] = cluster_count
                front.append(j)
        cluster_count += 1
    for i in np.flatnonzero(~core & (near & core).any(axis=1)):
        candidates = np.flatnonzero(near[i] & core)
        labels[i] = labels[candidates[np.argmin(squared[i, candidates])]]
    return labels


def k_nearest(
    points: np.ndarray,
    k: int,
    queries: np.ndarray | None = None,
    *,
    limit_squared: np.ndarray | float = np.inf,
    exclude_self: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Distances and indices of the k points with the smallest (squared distance, index), from a list of all of them.

    Rows are filled up with inf and -1.
    """
    queries = points if queries is None else queries
    distance, indices = np.full((len(queries), k), np.inf), np.full((len(queries), k), -1)
    limits = np.broadcast_to(limit_squared, len(queries))
    for i, query in enumerate(queries):
        with np.errstate(over="ignore"):
            d = points - query
            squared = (d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1]) + d[:, 2] * d[:, 2]
        order = np.argsort(squared, kind="stable")
        order = order[squared[order] <= limits[i]]
        order = order[order != i] if exclude_self else order
        order = order[:k]
        distance[i, : len(order)], indices[i, : len(order)] = np.sqrt(squared[order]), order
    return distance, indices
