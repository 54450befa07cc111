"""Derivatives of distances to neighbors, with respect to queries and to the points that are searched.

A search names the neighbors; a distance between two points has a closed form. The derivative of a distance of 0 is 0.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from geokit.core.gradients.library import Library, length
from geokit.core.gradients.rules import Asked, Rule
from geokit.errors import InputError
from geokit.points.gradients.pair_slopes_kernels import PAIR_SLOPES

# Rows that can be sorted by the point that they belong to: twice as many places, numbered with 31 bits.
MOST_SUMMED = 2**30 - 1


def _away(library: Library, queries: Any, points: Any, indices: Any) -> Any:
    """Distances of the queries (Q, 3) to the points with these indices (Q, k); 0 where there is none."""
    found = indices >= 0
    neighbors = library.take(points, library.where(found, indices, 0))
    return library.where(found, length(library, queries[:, None] - neighbors), 0.0)


def _nearest(library: Library, asked: Asked, answer: Any) -> tuple[Any, ...]:
    queries, points = _both(library, asked)
    return _away(library, queries, points, library.constant(answer[1], points)), None


def _both(library: Library, asked: Asked) -> tuple[Any, Any]:
    """Queries and points as tensors, one of which at least has gradients."""
    tensors = asked.tensors
    points = tensors.get("points")
    if points is None:
        points = library.constant(asked.arguments["self"]._given().numpy(), next(iter(tensors.values())))
    return tensors.get("queries", points), points


def _nearest_adjoint(asked: Asked, answer: Any, slopes: Any, wanted: list[str], arrays: Any) -> dict[str, Any] | None:
    return of_grid(asked, answer[1], slopes[0], wanted, arrays, width=answer[1].shape[1])


def _within_adjoint(asked: Asked, answer: Any, slopes: Any, wanted: list[str], arrays: Any) -> dict[str, Any] | None:
    grid, shifts = asked.arguments["self"], answer[3] if len(answer) > 3 else None
    if shifts is None:
        _require_no_images(asked)
    cell = None if shifts is None else grid._cell
    return of_grid(asked, answer[1], slopes[2], wanted, arrays, offsets=answer[0], shifts=shifts, cell=cell)


def of_grid(asked: Asked, indices: Any, by: Any, wanted: list[str], arrays: Any, **lists: Any) -> dict[str, Any] | None:
    """The derivatives by queries and points of a grid, in one kernel and, for the points, one sum."""
    grid, queries = asked.arguments["self"], asked.tensors.get("queries")
    count, pairs = len(grid) if queries is None else len(queries), math.prod(indices.shape)
    if by is None or arrays.device != grid._device or pairs + count > MOST_SUMMED:
        return None
    alone = queries is None
    of_points = _rows(arrays, (pairs + alone * count) * ("points" in wanted))
    of_queries = of_points if alone else _rows(arrays, count * ("queries" in wanted))
    given = grid._given() if alone else arrays.given(queries, 3)
    kinds = wp.float64 if alone else arrays.number, wp.float64
    ends = (given, grid._given(), kinds, count)
    _pull_pairs(arrays, ends, indices, by, (*of_queries, *of_points), pairs * alone, **lists)
    found = {"queries": of_queries[0]}
    if "points" in wanted:
        found["points"] = arrays.added(*of_points, len(asked.tensors["points"]))
    return {name: found[name] for name in wanted}


def _between_adjoint(asked: Asked, answer: Any, slopes: Any, wanted: list[str], arrays: Any) -> dict[str, Any] | None:
    """The derivatives by two clouds, of the distances of each to the other."""
    half = len(answer) // 2
    clouds, sizes = (asked.tensors["a"], asked.tensors["b"]), (len(asked.tensors["a"]), len(asked.tensors["b"]))
    ways = [way for way in (0, 1) if slopes[half * way] is not None]
    if not ways or sum(sizes) > MOST_SUMMED:
        return None
    # Of each cloud first what the distances of the other give, then what its own do.
    begins = [sizes[1 - cloud] if 1 - cloud in ways else 0 for cloud in (0, 1)]
    rows = [
        _rows(arrays, (begins[cloud] + (sizes[cloud] if cloud in ways else 0)) * (name in wanted))
        for cloud, name in enumerate("ab")
    ]
    for way in ways:
        given = [arrays.given(cloud, 3) for cloud in (clouds[way], clouds[1 - way])]
        ends = (*given, (arrays.number, arrays.number), sizes[way])
        outputs = (*rows[way], *rows[1 - way])
        _pull_pairs(arrays, ends, answer[half * way + 1], slopes[half * way], outputs, begins[way], width=1)
    found = zip("ab", rows, sizes, strict=True)
    return {name: arrays.added(*made, size) for name, made, size in found if name in wanted}


def _rows(arrays: Any, count: int) -> tuple[Any, Any]:
    """Room for slopes, and for the numbers of the points that have them."""
    return arrays.made(count, 3, wp.float64), arrays.made(count, 1, wp.int32)


def _pull_pairs(
    arrays: Any,
    ends: tuple[Any, Any, tuple[Any, Any], int],
    indices: Any,
    by: Any,
    outputs: tuple[Any, ...],
    begin: int,
    *,
    offsets: Any = None,
    width: int = 0,
    shifts: Any = None,
    cell: Any = None,
) -> None:
    queries, points, (query_number, point_number), count = ends
    offsets = arrays.made(0, 1, wp.int64) if offsets is None else offsets
    shifts = arrays.made(0, 1, wp.int32) if shifts is None else shifts
    lists = [arrays.given(offsets), width, arrays.given(indices), arrays.given(shifts)]
    box = wp.mat33d(*(np.zeros(9) if cell is None else np.ravel(cell)))
    inputs = [queries, points, *lists, box, arrays.given(by), begin]
    arrays.launch(PAIR_SLOPES[arrays.number, query_number, point_number], count, inputs, outputs)


def _nearest_shapes(asked: Asked) -> list[tuple[tuple[int, ...], str]]:
    count = len(asked.tensors["queries"]) if "queries" in asked.tensors else len(asked.arguments["self"])
    return [((count, asked.arguments["k"]), "float"), ((count, asked.arguments["k"]), "int32")]


def _within(library: Library, asked: Asked, answer: Any) -> tuple[Any, ...]:
    offsets, indices, *more = answer
    queries, points = _both(library, asked)
    rows = library.listed(library.constant(offsets, points), len(indices))
    there = library.take(points, library.constant(indices, points))
    if len(more) < 2:
        _require_no_images(asked)
    else:
        shifts = library.wide(library.constant(more[1], points))
        for axis, edge in enumerate(asked.arguments["self"]._cell.tolist()):
            there = there + library.stack([shifts[:, axis] * part for part in edge], -1)
    distance = length(library, library.take(queries, rows) - there)
    return (None, None, distance, *(None for _ in more[1:]))


def _require_no_images(asked: Asked) -> None:
    if asked.arguments["self"]._cell is not None:
        raise InputError("radius_search: distances to images of points have no gradient here; use neighbor_list()")


def _between(library: Library, asked: Asked, answer: Any) -> tuple[Any, ...]:
    a, b = asked.tensors["a"], asked.tensors["b"]
    there, back = (library.constant(index, a)[:, None] for index in (answer[1], answer[3]))
    return _away(library, a, b, there)[:, 0], None, _away(library, b, a, back)[:, 0], None


def _between_shapes(asked: Asked) -> list[tuple[tuple[int, ...], str]]:
    return [((len(asked.tensors[name]),), kind) for name in ("a", "b") for kind in ("float", "int32")]


def _between_groups(library: Library, asked: Asked, answer: Any) -> tuple[Any, ...]:
    there, _, back, _ = _between(library, asked, (answer[0], answer[1], answer[3], answer[4]))
    return there, None, None, back, None, None


def _between_groups_shapes(asked: Asked) -> list[tuple[tuple[int, ...], str]]:
    return [
        ((len(asked.tensors[name]) if part < 2 else len(asked.arguments["offsets"][0]) - 1,), kind)
        for name in ("a", "b")
        for part, kind in enumerate(("float", "int32", "int32"))
    ]


NEAREST = Rule((True, False), _nearest, adjoint=_nearest_adjoint, shapes=_nearest_shapes)
WITHIN = Rule((False, False, True), _within, adjoint=_within_adjoint, check=_require_no_images)
IMAGES = Rule((False, False, True, False), _within, adjoint=_within_adjoint)
BETWEEN_GROUPS = Rule(
    (True, False, False) * 2, _between_groups, adjoint=_between_adjoint, shapes=_between_groups_shapes
)
BETWEEN = Rule((True, False, True, False), _between, adjoint=_between_adjoint, shapes=_between_shapes)
