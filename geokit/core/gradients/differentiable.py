"""Queries that take tensors with gradients and give tensors that carry them."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import Any, TypeVar

from geokit.core.gradients.rules import (
    PLAIN,
    Asked,
    Call,
    Entry,
    is_on_tape,
    is_tracked,
    refuse_gradients,
    require_constant,
    untracked,
)
from geokit.core.launches import warp_private

__all__ = ["differentiable", "library_of", "of_constants", "undifferentiable"]

_Query = TypeVar("_Query", bound=Callable[..., Any])


def differentiable(
    rule: str, *inputs: str, single: bool = True, holders: tuple[str, ...] = ()
) -> Callable[[_Query], _Query]:
    """Make a query accept tensors that require gradients, and give tensors that carry them.

    Args:
        rule: Where the rule stands, as "package.module:NAME".
        inputs: Parameters that may be such tensors. Tensors that the first argument holds (:func:`hold`) count too.
        single: Whether rows of any leading axes are taken, (3,) or (B, N, 3), and answered with them.
        holders: Keywords whose objects may hold such tensors too; rules know them as "keyword.name".
    """

    def decorate(query: _Query) -> _Query:
        entry = Entry(query, rule, inputs, single, holders)

        @functools.wraps(query)
        def run(*args: Any, **kwargs: Any) -> Any:
            torch = sys.modules.get("torch")
            if torch is None:
                # Without torch, jax and a tape nothing can have a gradient; this costs a quarter of a microsecond.
                if "jax" not in sys.modules and warp_private.tape_in_progress() is None:
                    return query(*args, **kwargs)
            elif torch.compiler.is_compiling():
                from geokit.core.gradients.torch_operator import traced

                return traced(entry, args, kwargs)
            held = entry.held(args, kwargs)
            if not held and not any(map(is_tracked, args)) and not any(map(is_tracked, kwargs.values())):
                return query(*args, **kwargs)
            arguments = entry.bind(args, kwargs)
            for name in entry.others:
                if type(arguments[name]) not in PLAIN and is_tracked(arguments[name]):
                    raise refuse_gradients(name, arguments[name])
            lead = entry.flatten(arguments, held)
            # All inputs are tensors then, also those given as NumPy: so is the answer.
            tensors = {name: arguments[name] for name in inputs if arguments[name] is not None} | held
            answer = _attach(Call(entry, tuple(tensors), Asked(tensors, arguments)))
            return answer if lead is None else entry.shaped(answer, lead)

        return run  # type: ignore[return-value]

    return decorate


def undifferentiable(query: _Query) -> _Query:
    """Decorate a query of an object whose numbers have no gradient by the arrays of a tape that the object holds.

    While the tape records the query is refused, where the tape would get zeros.
    """

    @functools.wraps(query)
    def run(*args: Any, **kwargs: Any) -> Any:
        for holder in args[:1] or kwargs.values():
            require_constant(holder, query.__name__)
        return query(*args, **kwargs)

    return run  # type: ignore[return-value]


def of_constants(operation: _Query) -> _Query:
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
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(tensor, torch.Tensor):
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
