"""Derivatives of densities with respect to points and queries."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from geokit.core import launcher
from geokit.core.gradients.library import Library, length
from geokit.core.gradients.rules import Asked, Rule, split
from geokit.core.interop.user_arrays import read_numbers
from geokit.errors import InputError
from geokit.points.gradients.distances import of_grid
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


def _found(asked: Asked, device: Any) -> tuple[NeighborGrid, Any]:
    """The points as a grid, and the pairs within the radius. They are searched again: the sum has no use for a list."""
    points, queries = (split(asked.tensors.get(name, asked.tensors["points"]))[0] for name in ("points", "queries"))
    grid = NeighborGrid(points, float(asked.arguments["radius"]), device=device)
    return grid, grid.radius_search(queries)


def _pairs(library: Library, asked: Asked) -> tuple[Any, Any]:
    """Query and point of each pair within the radius."""
    _, found = _found(asked, asked.arguments["device"])
    return library.listed(found.offsets, len(found.indices)), library.whole(found.indices)


def _kernel(asked: Asked) -> str:
    kernel: str = asked.arguments["kernel"]
    if kernel == "count":
        raise InputError("kernel: 'count' has no derivative, it is a step; take cubic_spline, wendland_c2 or poly6")
    return kernel


def _density(library: Library, asked: Asked, answer: Any) -> tuple[Any, ...]:
    kernel, radius = _kernel(asked), float(asked.arguments["radius"])
    points = asked.tensors["points"]
    queries = asked.tensors.get("queries", points)
    row, other = asked.prepared
    away = length(library, library.take(queries, row) - library.take(points, other)) / radius
    mass = library.constant(np.broadcast_to(read_numbers(asked.arguments["mass"], "mass"), (len(points),)), points)
    return (library.add(library.take(mass, other) * _smoothed(library, kernel, away), row, len(queries)) / radius**3,)


def _adjoint(asked: Asked, answer: Any, slopes: Any, wanted: list[str], arrays: Any) -> dict[str, Any] | None:
    """The slopes of the distances by one kernel, and from them those of the points as of a search."""
    from geokit.points.clouds import density_slopes_kernels as kernels

    if arrays.device != launcher.resolve_device(asked.arguments["device"]) or slopes[0] is None:
        return None
    kernel = _kernel(asked)
    grid, found = _found(asked, arrays.device)
    smoothing: Any = kernels.SMOOTHING[kernel]()
    smoothing.inverse_radius = wp.float64(1.0 / float(asked.arguments["radius"]))
    mass = wp.array(np.ravel(read_numbers(asked.arguments["mass"], "mass")), dtype=wp.float64, device=arrays.device)
    by = arrays.made(len(found.indices), 1)
    lists = [arrays.given(part) for part in (found.offsets, found.indices, found.distance)]
    arrays.launch(
        kernels.DENSITY_SLOPES[kernel, arrays.number],
        len(found.offsets) - 1,
        [*lists, mass, smoothing, arrays.given(slopes[0])],
        [by],
    )
    asked = asked._replace(arguments={"self": grid})
    return of_grid(asked, found.indices, by, wanted, arrays, offsets=found.offsets)


def _shapes(asked: Asked) -> list[tuple[tuple[int, ...], str]]:
    return [((asked.tensors.get("queries", asked.tensors["points"]).shape[0],), "float")]


DENSITY = Rule((True,), _density, prepare=_pairs, adjoint=_adjoint, is_traced=False, check=_kernel, shapes=_shapes)
