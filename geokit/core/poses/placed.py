"""Queries of a surface or volume that stands somewhere else: rows are moved to it, and what is found is moved back."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.gradients.rules import held_by, is_tracked
from geokit.core.interop import user_arrays
from geokit.core.memory.needs import needs
from geokit.core.memory.needs import rows as count
from geokit.core.poses.move import BYTES_PER_MOVE, move, require_rigid
from geokit.errors import InputError

__all__ = ["placed", "without_gradients"]

_Arguments = ParamSpec("_Arguments")
_Answer = TypeVar("_Answer")


def placed(
    *names: str,
    directions: tuple[str, ...] = (),
    moved: tuple[str, ...] = (),
    turned: tuple[str, ...] = (),
    check: Callable[..., None] | None = None,
) -> Callable[[Callable[_Arguments, _Answer]], Callable[_Arguments, _Answer]]:
    """Decorate a query so that its option ``transform`` says where the surface or volume is.

    The query itself never sees the option. Rows and answers are moved in float64 on the device of the query.

    Args:
        names: The first parameters of the query after the surface or volume, rows of shape (N, 3).
        directions: Those of them that are turned only.
        moved: Fields of the answer that are points.
        turned: Fields of the answer that are directions; where it has no fields, the name of it all.
        check: Called beside a transform with the surface or volume and the query's options, to refuse some.
    """

    def decorate(query: Callable[_Arguments, _Answer]) -> Callable[_Arguments, _Answer]:
        @functools.wraps(query)
        def run(*given: _Arguments.args, **options: _Arguments.kwargs) -> _Answer:
            if "transform" not in options:
                return query(*given, **options)
            transform = options.pop("transform")
            return (
                query(*given, **options) if transform is None else moving(require_rigid(transform), *given, **options)
            )

        expected = (next(iter(inspect.signature(query).parameters)), *names)

        def bytes_of(*given: Any, transform: Any = None, **options: Any) -> int:
            own: int = query._geokit_bytes(*given, **options)  # type: ignore[attr-defined]
            rows = given[1] if len(given) > 1 else options.get(names[0])
            return own if transform is None else own + BYTES_PER_MOVE * len((*names, *moved, *turned)) * count(rows)

        @needs(
            lambda matrix, *given, **options: bytes_of(*given, transform=matrix, **options),
            late=True,
            name=query.__name__,
        )
        def moving(matrix: NDArray[np.float64], *given: Any, **options: Any) -> Any:
            if any(name not in options for name in expected[len(given) :]):
                return query(*given, **options)  # which names what is missing
            body, *values = *given, *(options.pop(name) for name in expected[len(given) :])
            if check is not None:
                check(body, **options)
            _refuse_tracked(body, dict(zip(names, values, strict=False)))
            device = body._device if hasattr(body, "_device") else launcher.resolve_device(options.get("device"))
            to_body: Any = np.linalg.inv(matrix)
            batches = user_arrays.read_rows(values[: len(names)], names, device)
            rows: list[Any] = [
                move(batch.array, to_body, turned=name in directions)
                for name, batch in zip(names, batches, strict=True)
            ]
            answer: Any = query(body, *rows, *values[len(names) :], **options)
            give = batches[0].to_caller
            if not isinstance(answer, tuple):
                return give(move(answer, matrix, turned=True) if turned else answer)
            found = answer._asdict()  # type: ignore[attr-defined]
            for field in (*moved, *turned):
                found[field] = move(found[field], matrix, turned=field in turned)
            if "offsets" in found:
                give = batches[0].to_lists or give
            return type(answer)(*map(give, found.values()))

        run._geokit_bytes = bytes_of  # type: ignore[attr-defined]
        return run

    return decorate


def without_gradients(
    *names: str,
) -> Callable[[Callable[_Arguments, _Answer]], Callable[_Arguments, _Answer]]:
    """Decorate a query that moves rows by itself: beside its ``transform`` tensors with gradients are refused."""

    def decorate(query: Callable[_Arguments, _Answer]) -> Callable[_Arguments, _Answer]:
        @functools.wraps(query)
        def run(*given: _Arguments.args, **options: _Arguments.kwargs) -> _Answer:
            if options.get("transform") is not None:
                rows = dict(zip(names, given[1:], strict=False)) | {n: options[n] for n in names if n in options}
                _refuse_tracked(given[0], rows)
            return query(*given, **options)

        return run

    return decorate


def _refuse_tracked(body: Any, rows: dict[str, Any]) -> None:
    """Refuse tensors with gradients, through which a transform carries none.

    Raises:
        InputError: The body holds such tensors, or some rows are one.
    """
    if held_by(body):
        raise InputError(
            f"transform: the {type(body).__name__} holds tensors with gradients; move the rows by their library"
        )
    for name, value in rows.items():
        if is_tracked(value):
            raise InputError(f"{name}: a tensor with gradients beside transform; move the rows by its library")
