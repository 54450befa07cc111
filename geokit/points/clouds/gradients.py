"""Derivatives of densities with respect to points, queries and masses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.gradients.library import Library, length
from geokit.core.gradients.rules import Asked, Rule
from geokit.errors import InputError
from geokit.points.neighbors.neighbor_grid import NeighborGrid

__all__ = ["DENSITY"]


def _smoothed(library: Library, kernel: str, q: Any) -> Any:
    """W * radius^3 at a share q of the radius, at most 1."""
    rest = 1.0 - q
    if kernel == "cubic_spline":
        inner = 1.0 - 6.0 * q * q + 6.0 * q * q * q
        return 8.0 / math.pi * library.where(q <= 0.5, inner, 2.0 * rest * rest * rest)
    if kernel == "wendland_c2":
        return 21.0 / (2.0 * math.pi) * rest**4 * (1.0 + 4.0 * q)
    return 315.0 / (64.0 * math.pi) * (1.0 - q * q) ** 3


def _pairs(library: Library, asked: Asked) -> tuple[Any, Any]:
    """Query and point of each pair within the radius. They are searched again: the sum has no use for their list."""
    points = asked.tensors["points"]
    grid = NeighborGrid(points, float(asked.arguments["radius"]), device=asked.arguments["device"])
    found = grid.radius_search(asked.tensors.get("queries", points))
    offsets = library.on_host(found.offsets)
    return np.repeat(np.arange(len(offsets) - 1), np.diff(offsets)), library.on_host(found.indices)


def _kernel(asked: Asked) -> str:
    kernel: str = asked.arguments["kernel"]
    if kernel == "count":
        raise InputError("kernel: 'count' has no derivative, it is a step; take cubic_spline, wendland_c2 or poly6")
    return kernel


def _density(library: Library, asked: Asked, answer: Any) -> tuple[Any, ...]:
    kernel, radius = _kernel(asked), float(asked.arguments["radius"])
    points = asked.tensors["points"]
    queries = asked.tensors.get("queries", points)
    row, other = (library.constant(numbers, points) for numbers in asked.prepared)
    away = length(library, library.take(queries, row) - library.take(points, other)) / radius
    mass = library.constant(np.broadcast_to(np.asarray(asked.arguments["mass"], np.float64), (len(points),)), points)
    return (library.add(library.take(mass, other) * _smoothed(library, kernel, away), row, len(queries)) / radius**3,)


def _slope(kernel: str, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """The derivative of :func:`_smoothed` by q."""
    rest = 1.0 - q
    if kernel == "cubic_spline":
        return 8.0 / math.pi * np.where(q <= 0.5, (18.0 * q - 12.0) * q, -6.0 * rest * rest)
    if kernel == "wendland_c2":
        return -210.0 / math.pi * q * rest**3
    return -945.0 / (32.0 * math.pi) * q * (1.0 - q * q) ** 2


def _adjoint(asked: Asked, answer: Any, slopes: Any, wanted: list[str], arrays: Any) -> dict[str, Any] | None:
    """First derivatives with NumPy, for jax, to which the number of pairs is not known before."""
    if not isinstance(slopes[0], np.ndarray):
        return None
    kernel, radius = _kernel(asked), float(asked.arguments["radius"])
    points = asked.tensors["points"].astype(np.float64)
    queries = asked.tensors.get("queries", points).astype(np.float64)
    grid = NeighborGrid(points, radius, device=asked.arguments["device"])
    found = grid.radius_search(queries)
    row, other = np.repeat(np.arange(len(queries)), np.diff(found.offsets)), found.indices
    away = queries[row] - points[other]
    size = np.sqrt((away * away).sum(1))
    mass = np.broadcast_to(np.asarray(asked.arguments["mass"], np.float64), (len(points),))
    share = np.divide(_slope(kernel, size / radius), size, out=np.zeros_like(size), where=size > 0.0)
    pulls = (slopes[0][row] * mass[other] * share / radius**4)[:, None] * away

    def added(rows: Any, count: int) -> NDArray[np.float64]:
        return np.stack([np.bincount(rows, pulls[:, axis], minlength=count) for axis in range(3)], axis=1)

    of_queries, of_points = added(row, len(queries)), -added(other, len(points))
    if "queries" in asked.tensors:
        return {"points": of_points, "queries": of_queries}
    return {"points": of_points + of_queries}


def _shapes(asked: Asked) -> list[tuple[tuple[int, ...], str]]:
    return [((asked.tensors.get("queries", asked.tensors["points"]).shape[0],), "float")]


DENSITY = Rule((True,), _density, prepare=_pairs, adjoint=_adjoint, is_traced=False, check=_kernel, shapes=_shapes)
