"""Derivatives of distances to neighbors, with respect to queries and to the points that are searched.

A search names the neighbors; a distance between two points has a closed form. The derivative of a distance of 0 is 0.
"""

from __future__ import annotations

from typing import Any

from geokit.core.gradients.library import Library, length
from geokit.core.gradients.rules import Asked, Rule
from geokit.errors import InputError

__all__ = ["BETWEEN", "BETWEEN_GROUPS", "IMAGES", "NEAREST", "WITHIN"]


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


NEAREST = Rule((True, False), _nearest, shapes=_nearest_shapes)
WITHIN = Rule((False, False, True), _within, check=_require_no_images)
IMAGES = Rule((False, False, True, False), _within)
BETWEEN_GROUPS = Rule((True, False, False) * 2, _between_groups, shapes=_between_groups_shapes)
BETWEEN = Rule((True, False, True, False), _between, shapes=_between_shapes)
