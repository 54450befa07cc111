"""Answers that carry gradients: of tensors of torch that require them, tracers of jax and arrays on a tape of warp."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import Any, TypeVar

from geokit.core.base.query import Query
from geokit.core.gradients.rules import (
    PLAIN,
    Asked,
    Call,
    held_by,
    is_on_tape,
    is_torch_tensor,
    is_tracked,
    refuse_gradients,
    require_constant,
    shaped,
    untracked,
)
from geokit.core.interop.arrays import broadcast_rows, flat_rows, lead_of, widened
from geokit.core.interop.objects import points_of
from geokit.core.launches import warp_private
from geokit.core.require import read_array
from geokit.errors import InputError

_Operation = TypeVar("_Operation", bound=Callable[..., Any])


def with_gradients(query: Query, given: tuple[Any, ...], options: dict[str, Any]) -> Any:
    """The answer of a call, with tensors that carry gradients; None for a call without gradients.

    Raises:
        InputError: An argument is a tensor with gradients, and the answer carries none for it.
    """
    torch = sys.modules.get("torch")
    if torch is None:
        # Without torch, jax and a tape nothing can have a gradient; this costs a quarter of a microsecond.
        if "jax" not in sys.modules and warp_private.tape_in_progress() is None:
            return None
    elif torch.compiler.is_compiling():
        from geokit.core.gradients.torch_operator import traced

        return traced(query, given, options)
    held = _held(query, given, options)
    if not held and not any(map(is_tracked, given)) and not any(map(is_tracked, options.values())):
        return None
    arguments = query.bind(given, options)
    for name in query.others:
        if type(arguments[name]) not in PLAIN and is_tracked(arguments[name]):
            raise refuse_gradients(name, arguments[name])
    lead = _flattened(query, arguments, held)
    # All inputs are tensors then, also those given as NumPy: so is the answer.
    tensors = {name: arguments[name] for name in query.inputs if arguments[name] is not None} | held
    answer = _attach(Call(query, tuple(tensors), Asked(tensors, arguments)))
    return answer if lead is None else shaped(query, answer, lead)


def of_constants(operation: _Operation) -> _Operation:
    """Decorate an operation without gradients: it gets objects without the tensors that they hold.

    Queries of an object that holds tensors answer with tensors that carry gradients, also where the operation asks.
    While a tape records, an object that holds its arrays is refused.
    """

    def constant(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: constant(one) for name, one in value.items()}
        require_constant(value, operation.__name__)
        return untracked(value)

    @functools.wraps(operation)
    def run(*args: Any, **kwargs: Any) -> Any:
        return operation(*map(constant, args), **constant(kwargs))

    return run  # type: ignore[return-value]


def library_of(tensor: Any) -> Any:
    """The library of a tensor (:class:`geokit.core.gradients.library.Library`)."""
    if is_torch_tensor(tensor):
        from geokit.core.gradients import with_torch as library
    else:
        from geokit.core.gradients import with_jax as library  # type: ignore[no-redef]
    return library.LIBRARY


def _attach(call: Call) -> Any:
    if warp_private.tape_in_progress() is not None and any(map(is_on_tape, call.asked.tensors.values())):
        from geokit.core.gradients import on_tape

        return on_tape.attach(call)
    if any(getattr(value, "requires_grad", False) is True for value in call.asked.tensors.values()):
        from geokit.core.gradients import with_torch

        return with_torch.attach(call)
    from geokit.core.gradients import with_jax

    return with_jax.attach(call)


def _held(query: Query, given: tuple[Any, ...], options: dict[str, Any]) -> dict[str, Any]:
    """The tensors that the objects of a call hold, by name; "keyword.name" for those of other holders."""
    found = held_by(given[0] if given else options.get(query.parameters[0][0]))
    for holder in query.holders:
        found = {**found, **{f"{holder}.{key}": value for key, value in held_by(options.get(holder)).items()}}
    return found


def _flattened(query: Query, arguments: dict[str, Any], held: dict[str, Any]) -> tuple[int, ...] | None:
    """Make tables of inputs that are objects with points, or have other leading axes than one.

    Returns:
        The leading axes of the answer; None for those of a table.
    Raises:
        InputError: It is one point, and a tape of warp records the call: warp has no arrays of no dimension.
    """
    given = {
        name: arguments[name] if is_torch_tensor(arguments[name]) else points_of(arguments[name], name)
        for name in query.inputs
        if arguments[name] is not None
    }
    arguments.update(given)
    are_rays = query.inputs == ("origins", "directions")
    if not given or not (query.is_single or are_rays):
        return None
    rows = {name: value if hasattr(value, "ndim") else read_array(value, name) for name, value in given.items()}
    if any(is_on_tape(value) and lead_of(value) == () for value in rows.values()) or (
        all(lead_of(value) == () for value in rows.values()) and any(map(is_on_tape, held.values()))
    ):
        raise InputError(
            f"{', '.join(rows)}: a single row has no gradient on a wp.Tape; give it as a table of shape (1, 3)"
        )
    rows = {name: widened(value) for name, value in (broadcast_rows(rows) if are_rays else rows).items()}
    arguments.update(rows)
    lead = None
    for name, value in rows.items() if query.is_single else ():
        arguments[name], lead = flat_rows(value)
    return lead
