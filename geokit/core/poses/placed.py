"""Queries of a surface or volume that stands somewhere else: rows are moved to it, and what is found is moved back."""

from __future__ import annotations

from typing import Any

import numpy as np

from geokit.core import launcher
from geokit.core.base.query import Query
from geokit.core.gradients.rules import held_by, is_tracked
from geokit.core.interop import user_arrays
from geokit.core.poses.move import move, require_rigid
from geokit.errors import InputError

__all__ = ["answer", "refuse_tracked"]


def answer(query: Query, given: tuple[Any, ...], options: dict[str, Any]) -> Any:
    """The answer of a call whose option ``transform`` says where the surface or volume is.

    The query itself never sees the option. Rows and answers are moved in float64 on the device of the query.

    Raises:
        InputError: The transform is not rigid, the query refuses it, or rows or the body carry gradients.
    """
    options = dict(options)
    matrix = require_rigid(options.pop("transform"))
    expected = query.positional[: 1 + len(query.rows)]
    if any(name not in options for name in expected[len(given) :]):
        return query.call(*given, **options)  # which names what is missing
    body, *values = *given, *(options.pop(name) for name in expected[len(given) :])
    if query.places is not None:
        query.places(body, **options)
    refuse_tracked(query, (body, *values), options)
    device = body._device if hasattr(body, "_device") else launcher.resolve_device(options.get("device"))
    to_body: Any = np.linalg.inv(matrix)
    batches = user_arrays.read_rows(values[: len(query.rows)], query.rows, device)
    rows: list[Any] = [
        move(batch.array, to_body, turned=name == "directions") for name, batch in zip(query.rows, batches, strict=True)
    ]
    found: Any = query.call(body, *rows, *values[len(query.rows) :], **options)
    give = batches[0].to_caller
    if query.kind is None:
        return give(move(found, matrix, turned=True) if query.is_turned else found)
    fields = found._asdict()
    for field in query.moved:
        fields[field] = move(fields[field], matrix, turned=field == "normals")
    if query.is_ragged:
        give = batches[0].to_lists or give
    return query.kind(*map(give, fields.values()))


def refuse_tracked(query: Query, given: tuple[Any, ...], options: dict[str, Any]) -> None:
    """Refuse tensors with gradients beside a transform, through which it carries none.

    Raises:
        InputError: The body holds such tensors, or some rows are one.
    """
    if held_by(given[0]):
        raise InputError(
            f"transform: the {type(given[0]).__name__} holds tensors with gradients; move the rows by their library"
        )
    rows = dict(zip(query.rows, given[1:], strict=False))
    for name, value in (rows | {name: options[name] for name in query.rows if name in options}).items():
        if is_tracked(value):
            raise InputError(f"{name}: a tensor with gradients beside transform; move the rows by its library")
