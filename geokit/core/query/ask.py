"""How queries are asked: the record of a query says what it is, and every call takes the steps of :func:`ask`."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np

from geokit.core.base.query import Query
from geokit.core.base.snapshot import snapshot
from geokit.core.blocks import several_devices
from geokit.core.gradients.differentiable import with_gradients
from geokit.core.gradients.rules import require_constant
from geokit.core.launches import prepared
from geokit.core.memory.needs import estimated, guarded
from geokit.core.memory.needs import rows as count
from geokit.core.poses.move import BYTES_PER_MOVE, answer_placed, refuse_tracked
from geokit.core.query import in_graphs

_Arguments = ParamSpec("_Arguments")
_Answer = TypeVar("_Answer")


def query(*rows: str, **facts: Any) -> Callable[[Callable[_Arguments, _Answer]], Callable[_Arguments, _Answer]]:
    """Make a query of a function or method, which gets the record as its attribute ``query``.

    Args:
        rows: Its parameters after the object that are rows.
        facts: The other attributes of its :class:`geokit.core.base.query.Query`.
    """

    def decorate(function: Callable[_Arguments, _Answer]) -> Callable[_Arguments, _Answer]:
        record = Query(function, rows, **facts)

        @functools.wraps(function)
        def run(*given: _Arguments.args, **options: _Arguments.kwargs) -> _Answer:
            found: _Answer = ask(record, given, options)
            return found

        record.call = run
        record.answer = lambda *given, **options: prepared.answer(record, _search, given, options)
        run.query, run._geokit_bytes = record, functools.partial(_need, record)  # type: ignore[attr-defined]
        return run

    return decorate


def ask(query: Query, given: tuple[Any, ...], options: dict[str, Any]) -> Any:
    """Answer a call of a query.

    What follows the steps here is the function's own: it reads the rows, of any library, in the blocks that fit
    (``core/interop/user_arrays.py``, ``core/blocks/chunked_queries.py``), launches its kernels, looks at the flags that
    they raise, and hands the answer out in the caller's kind of array.
    """
    # 1. On several devices each answers a block of the rows, by a call of its own; of many poses those of all.
    if query.least_rows is not None and several_devices.are_asked(given, options) and not _is_posed(query, options):
        return several_devices.answer(query, given, options)
    # 2. Where a transform says where the object is, the rows are moved to it, and what is found is moved back.
    if query.is_placed and "transform" in options:
        if options["transform"] is None:
            del options["transform"]
        elif query.is_packed:
            refuse_tracked(query, given, options)
        else:
            need = functools.partial(_need, query, *given, **options)
            return guarded(query.name, need, answer_placed, query, given, options)
    # 3. Tensors with gradients, also those that the object holds, give an answer that carries them.
    if query.gradient is not None:
        answer = with_gradients(query, given, options)
        if answer is not None:
            return answer
    elif not query.is_stepped:
        for holder in given[:1] or options.values():
            require_constant(holder, query.name)
    # 4. A small call on a CPU that was made before: its launches again, for these rows.
    return prepared.answer(query, _search, given, options)


def _search(query: Query, given: tuple[Any, ...], options: dict[str, Any]) -> Any:
    # 5. A call that a CUDA graph captures was made before.
    return in_graphs.answer(query, _asked, given, options)


def _asked(query: Query, given: tuple[Any, ...], options: dict[str, Any]) -> Any:
    # 6. An object that another thread may update meanwhile is asked as it is now.
    if query.is_method and given and hasattr(type(given[0]), "update"):
        given = (snapshot(given[0]), *given[1:])
    # 7. The function itself; where memory runs out, the error says what the call needs.
    return guarded(query.name, functools.partial(_need, query, *given, **options), query.function, *given, **options)


def _need(query: Query, *given: Any, **options: Any) -> int:
    """The memory that a call needs [bytes]."""
    poses = math.prod(transform_axes(options)[:-2]) if not query.is_packed else 1
    transform = options.pop("transform", None) if query.is_placed else None
    first = query.rows[:1]
    rows = poses * (count(given[1] if len(given) > 1 else options.get(*first)) if first else 0)
    moves = 0 if transform is None else len(query.rows) + len(query.moved)
    return estimated(query.memory, given, options) + (query.row_bytes + BYTES_PER_MOVE * moves) * rows


def transform_axes(options: dict[str, Any]) -> tuple[int, ...]:
    """Those of a transform, three for many poses; none of what the call will refuse."""
    given: Any = options.get("transform")
    if given is None:
        return ()
    try:
        return np.shape(given)
    except Exception:
        return ()


def _is_posed(query: Query, options: dict[str, Any]) -> bool:
    """Whether many poses are asked, whose axis is before that of the rows."""
    return query.is_placed and not query.is_packed and len(transform_axes(options)) == 3
