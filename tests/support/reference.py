"""Slow and obviously right: float64 NumPy answers to compare geokit's with, in code that no query of geokit's runs."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from geokit.accuracy.reference import mesh
from geokit.accuracy.reference.mesh import (
    ClosestReference,
    RayReference,
    closest_point,
    first_hit,
    k_nearest,
    neighbors_within,
    segment_parameter,
    signed_distance,
    winding_number,
)
from geokit.accuracy.reference.volume import (
    axis_weights,
    borders_along,
    first_level,
    interpolant_along,
    tensor_interpolant,
)

__all__ = [
    "ClosestReference",
    "RayReference",
    "all_ray_hits",
    "axis_weights",
    "borders_along",
    "box_distance",
    "closest_on_segments",
    "closest_point",
    "common_points",
    "first_hit",
    "first_level",
    "interpolant_along",
    "intersecting_pairs",
    "k_nearest",
    "meet_beyond_shared",
    "neighbors_within",
    "signed_distance",
    "squared_triangle_distance",
    "tensor_interpolant",
    "triangle_meets_box",
    "triangles_meet",
    "trilinear",
    "trilinear_gradient",
    "winding_number",
]


def all_ray_hits(
    vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters t (N, T), inf for a miss, and barycentric (N, T, 3) of each ray on each triangle, edges included.

    A ray hits if it passes all three edges on the same side; t is in units of the direction's length. Triangles without
    area are never hit.
    """
    corners = mesh._corners(vertices, faces)
    origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
    times = np.full((len(origins), len(corners)), np.inf)
    weights = np.zeros((len(origins), len(corners), 3))
    for rows in mesh._blocks(len(origins), len(corners)):
        times[rows], weights[rows] = mesh._crossings(corners, origins[rows][:, None], directions[rows][:, None])
    return times, weights


def closest_on_segments(a: np.ndarray, b: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Distance (N,) from each query to the nearest of the segments a[i] - b[i]."""
    target = np.asarray(queries, np.float64)[:, None]
    along = segment_parameter(a, b, target)[..., None]
    return np.linalg.norm(a + along * (b - a) - target, axis=2).min(axis=1)


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


def squared_triangle_distance(t: np.ndarray, u: np.ndarray) -> Fraction:
    """Least squared distance of two closed triangles (3, 3), exactly, be they segments or points.

    Each vertex, edge and face of one against each of the other: where the nearest points of the lines or planes through
    them lie within both, they count.
    """
    corners, others = _rational(t), _rational(u)
    subsets = [(0,), (1,), (2,), (0, 1), (1, 2), (2, 0), (0, 1, 2)]
    found = []
    for one in subsets:
        for other in subsets:
            p, q = corners[one[0]], others[other[0]]
            along = [_minus(corners[k], p) for k in one[1:]] + [_minus(q, others[k]) for k in other[1:]]
            shares = _least_squares(along, _minus(q, p))
            if shares is None:
                continue
            mine, its = shares[: len(one) - 1], shares[len(one) - 1 :]
            if min([*mine, *its, 1 - sum(mine), 1 - sum(its)]) < 0:
                continue
            rest = _minus(p, q)
            for share, axis in zip(shares, along, strict=True):
                rest = tuple(x + share * y for x, y in zip(rest, axis, strict=True))
            found.append(_rational_dot(rest, rest))
    return min(found)


def _least_squares(along: list[tuple], toward: tuple) -> list[Fraction] | None:
    """Weights of the axes whose sum is nearest to a vector; None where they depend on each other."""
    rows = [[_rational_dot(a, b) for b in along] + [_rational_dot(a, toward)] for a in along]
    for i, row in enumerate(rows):
        if row[i] == 0:
            return None
        row[:] = [x / row[i] for x in row]
        for k, other in enumerate(rows):
            if k != i:
                other[:] = [x - other[i] * y for x, y in zip(other, row, strict=True)]
    return [row[-1] for row in rows]


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


def box_distance(points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Signed distance (N,) to a box, negative inside [world]."""
    beyond = np.maximum(np.asarray(lower) - points, points - np.asarray(upper))
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


def union_of_balls(points: np.ndarray, centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Least of ``|x - p| - r`` over all balls (p, r), for each of the points (N, 3)."""
    least = np.full(len(points), np.inf)
    for center, radius in zip(centers, np.broadcast_to(radii, len(centers)), strict=True):
        least = np.minimum(least, np.sqrt(((points - center) ** 2).sum(axis=1)) - radius)
    return least


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
            center = points.mean(axis=0)
            shift = x[3:] + np.cross(x[:3], center - p.mean(axis=0))
            move[:3, 3] = center + shift - move[:3, :3] @ center
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
