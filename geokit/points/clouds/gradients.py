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


def _kernel(asked: Asked) -> str:
    kernel: str = asked.arguments["kernel"]
    if kernel == "count":
        raise InputError("kernel: 'count' has no derivative, it is a step; take cubic_spline, wendland_c2 or poly6")
    return kernel


def _found(asked: Asked) -> tuple[NeighborGrid, Any]:
    """The points as a grid, and the pairs within the radius. They are searched again: the sum has no use for a list."""
    points = asked.tensors["points"]
    grid = NeighborGrid(split(points)[0], float(asked.arguments["radius"]), device=asked.arguments["device"])
    return grid, grid.radius_search(split(asked.tensors.get("queries", points))[0])


def _slope(library: Library, kernel: str, q: Any) -> Any:
    """The derivative of W * radius^3 by a share q of the radius, at most 1."""
    rest = 1.0 - q
    if kernel == "cubic_spline":
        return 8.0 / math.pi * library.where(q <= 0.5, (18.0 * q - 12.0) * q, -6.0 * rest * rest)
    if kernel == "wendland_c2":
        return -210.0 / math.pi * q * rest**3
    return -945.0 / (32.0 * math.pi) * q * (1.0 - q * q) ** 2


def _pull(library: Library, asked: Asked, answer: Any, slopes: Any) -> dict[str, Any]:
    radius, found = float(asked.arguments["radius"]), _found(asked)[1]
    points, slope = library.wide(asked.tensors["points"]), library.wide(slopes[0])
    queries = library.wide(asked.tensors.get("queries", points))
    row, other = library.listed(found.offsets, len(found.indices)), library.whole(found.indices)
    mass = library.constant(np.broadcast_to(read_numbers(asked.arguments["mass"], "mass"), (len(points),)), points)
    away = library.take(queries, row) - library.take(points, other)
    far = length(library, away)
    by_far = library.take(slope, row) * mass[other] * _slope(library, _kernel(asked), far / radius) / radius**4
    pulls = (by_far / library.where(far > 0.0, far, 1.0))[:, None] * away
    of_queries, of_points = library.add(pulls, row, len(queries)), -library.add(pulls, other, len(points))
    if "queries" in asked.tensors:
        return {"points": of_points, "queries": of_queries}
    return {"points": of_points + of_queries}


def _adjoint(asked: Asked, answer: Any, slopes: Any, wanted: list[str], arrays: Any) -> dict[str, Any] | None:
    """The slopes of the distances by one kernel, and from them those of the points as of a search."""
    from geokit.points.clouds import density_slopes_kernels as kernels

    if arrays.device != launcher.resolve_device(asked.arguments["device"]) or slopes[0] is None:
        return None
    kernel = _kernel(asked)
    grid, found = _found(asked)
    smoothing: Any = kernels.SMOOTHING[kernel]()
    smoothing.inverse_radius = wp.float64(1.0 / float(asked.arguments["radius"]))
    mass = wp.array(np.ravel(read_numbers(asked.arguments["mass"], "mass")), dtype=wp.float64, device=arrays.device)
    by = arrays.made(len(found.indices), 1)
    lists = [arrays.given(part) for part in (found.offsets, found.indices, found.distance)]
    arrays.launch(
        kernels.DENSITY_SLOPES[kernel][arrays.number],
        len(found.offsets) - 1,
        [*lists, mass, smoothing, arrays.given(slopes[0])],
        [by],
    )
    asked = asked._replace(arguments={"self": grid})
    return of_grid(asked, found.indices, by, wanted, arrays, offsets=found.offsets)


def _shapes(asked: Asked) -> list[tuple[tuple[int, ...], str]]:
    return [((asked.tensors.get("queries", asked.tensors["points"]).shape[0],), "float")]


DENSITY = Rule((True,), pull=_pull, adjoint=_adjoint, is_traced=False, check=_kernel, shapes=_shapes)
