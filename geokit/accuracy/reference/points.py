"""Independent reference for neighbors and plane fits: float64 NumPy over all distances, without code shared with
geokit."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


class PlaneReference(NamedTuple):
    """Plane fits to neighborhoods of points.

    Attributes:
        normals: Unit normals, of either sign, shape (Q, 3).
        gap: Difference of the two least eigenvalues of the covariance over the largest, shape (Q,). If it is 0 there is
            no unique best plane; 0 if all points coincide.
    """

    normals: Floats
    gap: Floats


def neighbors_within(points: ArrayLike, queries: ArrayLike, radius: float) -> list[NDArray[np.int64]]:
    """For each query, the ascending indices of the points at a distance of at most ``radius``.

    The test is ``(dx * dx + dy * dy) + dz * dz <= radius * radius``, rounded term by term.
    """
    points, queries = np.asarray(points, np.float64), np.asarray(queries, np.float64)
    axes = np.ascontiguousarray(points.T)
    return [np.flatnonzero(_squared(axes, query) <= radius * radius) for query in queries]


def k_nearest(
    points: NDArray[Any],
    k: int,
    queries: NDArray[Any] | None = None,
    *,
    limit_squared: NDArray[Any] | float = np.inf,
    exclude_self: bool = False,
) -> tuple[Floats, NDArray[np.int64]]:
    """Distances and indices of the k points with the smallest (squared distance, index), from all distances.

    Args:
        points: Positions, shape (P, 3).
        k: Number of points.
        queries: Query positions, shape (N, 3); None for the points themselves.
        limit_squared: Points at a larger squared distance do not count; one for all queries or one for each.
        exclude_self: Point i does not count for query i.
    Returns:
        Distances and indices (N, k), the nearest first; rows are padded with inf and -1.
    """
    queries = points if queries is None else queries
    distance, indices = np.full((len(queries), k), np.inf), np.full((len(queries), k), -1)
    limits = np.broadcast_to(limit_squared, len(queries))
    axes = np.ascontiguousarray(np.asarray(points, np.float64).T)
    for i, query in enumerate(np.asarray(queries, np.float64)):
        squared = _squared(axes, query)
        order = np.arange(len(squared))
        if k + 1 < len(squared):
            # One more than needed, because the query itself may be among them. All ties with the last one are kept.
            order = np.flatnonzero(squared <= np.partition(squared, k)[k])
        order = order[np.argsort(squared[order], kind="stable")]
        order = order[squared[order] <= limits[i]]
        if exclude_self:
            order = order[order != i]
        order = order[:k]
        distance[i, : len(order)], indices[i, : len(order)] = np.sqrt(squared[order]), order
    return distance, indices


def plane_normals(points: ArrayLike, neighbors: ArrayLike) -> PlaneReference:
    """Least-squares planes through the neighbors of Q points.

    Args:
        points: Positions, shape (N, 3).
        neighbors: Indices of the points of each neighborhood, shape (Q, k).
    Returns:
        PlaneReference.
    """
    near = np.asarray(points, np.float64)[np.asarray(neighbors)]
    near = near - near.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("qki,qkj->qij", near, near))
    gap = (values[:, 1] - values[:, 0]) / np.where(values[:, 2] > 0.0, values[:, 2], 1.0)
    return PlaneReference(vectors[:, :, 0], gap)


def _squared(axes: Floats, query: Floats) -> Floats:
    """Squared distances of points, given axis by axis, from a query, rounded term by term."""
    with np.errstate(over="ignore"):
        dx, dy, dz = (axis - at for axis, at in zip(axes, query, strict=True))
        squared: Floats = (dx * dx + dy * dy) + dz * dz
    return squared
