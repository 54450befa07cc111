"""Rules of gradients: how an answer depends on what was asked and on what an object holds.

A query searches once, without gradients. Its rule then has the closed form of the answer's derivative, so that a
backward pass searches nothing. A rule knows no library: it is written with the functions of a
:class:`~geokit.core.gradients.library.Library`. Torch and jax differentiate what it builds; for a tape of warp it is
followed through NumPy.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

from numpy.typing import NDArray

from geokit.core.interop.arrays import broadcast_rows, detached, flat_rows, lead_of, led, widened
from geokit.core.interop.objects import points_of
from geokit.core.launches import warp_private
from geokit.core.require import read_array, refuse_recording
from geokit.errors import InputError

__all__ = [
    "PLAIN",
    "Asked",
    "Call",
    "Deferred",
    "Entry",
    "Rule",
    "held_by",
    "hold",
    "is_on_tape",
    "is_tracked",
    "is_warp_array",
    "refuse_gradients",
    "require_constant",
    "split",
    "untracked",
]

# Attribute of an object (Surface, SparseVolume, NeighborGrid) that holds tensors with gradients.
_HELD = "_held_tensors"
# Types of options, which neither are tensors nor hold any.
PLAIN = frozenset((bool, int, float, str, type(None)))


class Rule(NamedTuple):
    """How an answer depends on tensors; those of a tape of warp are arrays of NumPy here.

    Attributes:
        build: ``build(library, asked, answer)`` gives each output again as a function of the tensors, or None where an
            output has no derivative. ``asked`` is a :class:`Asked`; ``answer`` is a tuple of tensors that count as
            constants.
        prepare: ``prepare(library, asked)``: searches of the backward pass, for constant tensors; ``build`` may not
            search.
        quick: ``quick(library, asked, answer, slopes, wanted)``: the first derivatives that are wanted, by name, where
            there is a shorter way than through ``build``; None where there is not. A slope is None where it is 0. It
            may look at values, so jax does not ask for it.
        pull: In place of ``build``: ``pull(library, asked, answer, slopes)`` gives the derivative with respect to each
            tensor in ``asked.tensors``, by name; ``slopes`` are those with respect to the outputs.
        has_slope: For each output, whether it has a derivative.
        on_host: ``on_host(asked)(asked, slopes)`` gives the first derivatives for NumPy arrays, by name, where
            ``prepare`` finds arrays whose shapes depend on values: jax calls it in place of ``build``. The first call
            sees tracers.
        on_device: ``on_device(asked, answer, slopes, totals)`` adds the first derivatives to ``totals``, arrays of warp
            by name, and returns whether it could: a shorter way for a tape of warp. All its arrays are contiguous, on
            one device and of one precision, vectors where there are rows of three; a slope is None where there is none.
        on_tensors: ``on_tensors(asked, answer, slopes, wanted)``: what ``quick`` gives, by a kernel on tensors of torch
            where they lie; None where there is none for this call. It reads their memory only: they may be in a graph.
        at_once: ``at_once(asked)`` gives the answer to tensors of torch, a tuple, together with its derivative by each
            number of the first tensor, where one kernel finds both; None where none does. Of an answer (N,) to rows
            (N, 3), the derivative is (N, 3).
        check: ``check(asked)`` raises the error for a call that has no derivative, where a tape of warp must know it
            before the answer.
        shapes: ``shapes(asked)`` gives shape and kind ("float" for that of the tensors, or "int32") of each output, for
            jax and torch.compile, which need them before the answer.
    """

    has_slope: tuple[bool, ...]
    build: Callable[..., tuple[Any, ...]] | None = None
    prepare: Callable[..., Any] | None = None
    quick: Callable[..., dict[str, Any] | None] | None = None
    pull: Callable[..., dict[str, Any]] | None = None
    on_host: Callable[[Asked], Callable[[Asked, Any], dict[str, Any]]] | None = None
    on_device: Callable[..., bool] | None = None
    on_tensors: Callable[..., dict[str, Any] | None] | None = None
    at_once: Callable[[Asked], tuple[tuple[Any, ...], Any] | None] | None = None
    check: Callable[[Asked], None] | None = None
    shapes: Callable[..., list[tuple[tuple[int, ...], str]]] | None = None


class Asked(NamedTuple):
    """One call.

    Attributes:
        tensors: What the answer depends on, by name: tensors of the call and those that the object holds.
        arguments: All arguments by name, also the object under its parameter's name.
        prepared: What the rule's ``prepare`` found.
    """

    tensors: dict[str, Any]
    arguments: dict[str, Any]
    prepared: Any = None


class Entry:
    """A query that may carry gradients.

    Attributes:
        query: The query, for arguments without gradients.
        rule: Gives its rule.
        inputs: Parameters that may be tensors with gradients.
        single: Whether rows of any leading axes are taken, also one point of shape (3,).
        holders: Parameters besides the first whose objects may hold tensors.
        parameters: Names and defaults of all parameters.
        others: Names of those that are no inputs.
        kind: Container of the outputs: a NamedTuple's class, or None for a single array.
        address: Of this object.
    """

    def __init__(
        self, query: Callable[..., Any], rule: str, inputs: tuple[str, ...], single: bool, holders: tuple[str, ...] = ()
    ) -> None:
        signature = inspect.signature(query)
        self.query, self.inputs, self._rule, self.single, self.holders = query, inputs, rule, single, holders
        self._signature = signature
        self._found: Rule | None = None
        self.parameters = tuple((name, parameter.default) for name, parameter in signature.parameters.items())
        self.others = tuple(name for name, _ in self.parameters if name not in inputs)
        self._defaults = dict(self.parameters)
        self._positional = tuple(
            name for name, parameter in signature.parameters.items() if parameter.kind is not parameter.KEYWORD_ONLY
        )
        # Results are defined above the queries that return them.
        kind = inspect.unwrap(query).__globals__.get(str(signature.return_annotation))
        self.kind: Any = kind if hasattr(kind, "_fields") else None
        self.address = id(self)

    def rule(self) -> Rule:
        """The query's rule; its module is imported by the first call with gradients."""
        if self._found is not None:
            return self._found
        module, _, name = self._rule.partition(":")
        found: Rule = getattr(importlib.import_module(module), name)
        self._found = found
        return found

    def run(self, arguments: dict[str, Any]) -> Any:
        """The answer for arguments without gradients."""
        # Rows go by position: small calls are replayed then.
        rest = {name: value for name, value in arguments.items() if name not in self._positional}
        return self.query(*(arguments[name] for name in self._positional), **rest)

    def held(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> dict[str, Any]:
        """The tensors that the objects of a call hold, by name; "keyword.name" for those of other holders."""
        found = held_by(args[0] if args else kwargs.get(self.parameters[0][0]))
        for holder in self.holders:
            found = {**found, **{f"{holder}.{key}": value for key, value in held_by(kwargs.get(holder)).items()}}
        return found

    def owner(self, name: str) -> tuple[str, str]:
        """The parameter whose object holds a tensor, and the tensor's name there."""
        holder, _, key = name.rpartition(".")
        return holder or self.parameters[0][0], key

    def flatten(self, arguments: dict[str, Any], held: dict[str, Any]) -> tuple[int, ...] | None:
        """Make tables of inputs that are objects with points, or have other leading axes than one.

        Returns:
            The leading axes of the answer; None for those of a table.
        Raises:
            InputError: It is one point, and a tape of warp records the call: warp has no arrays of no dimension.
        """
        given = {
            name: arguments[name] if _is_torch_tensor(arguments[name]) else points_of(arguments[name], name)
            for name in self.inputs
            if arguments[name] is not None
        }
        arguments.update(given)
        are_rays = self.inputs == ("origins", "directions")
        if not given or not (self.single or are_rays):
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
        for name, value in rows.items() if self.single else ():
            arguments[name], lead = flat_rows(value)
        return lead

    def shaped(self, answer: Any, lead: tuple[int, ...]) -> Any:
        """The answer with other leading axes, from that for a table of the rows; lists stay those of the table."""
        if "offsets" in getattr(self.kind, "_fields", ()):
            return answer
        return led(answer, lead) if self.kind is None else self.kind(*(led(out, lead) for out in answer))

    def bind(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> dict[str, Any]:
        """All arguments of a call by name.

        Raises:
            TypeError: The call does not fit the query.
        """
        given = dict(zip(self._positional, args, strict=False))
        found = {**self._defaults, **given, **kwargs}
        fits = len(given) == len(args) and len(found) == len(self._defaults) and given.keys().isdisjoint(kwargs)
        if fits and not any(value is inspect.Parameter.empty for value in found.values()):
            return found
        # What does not fit is named there, which takes ten times as long.
        bound = self._signature.bind(*args, **kwargs)
        bound.apply_defaults()
        return dict(bound.arguments)


class Call(NamedTuple):
    """A call of a query that is to carry gradients.

    Attributes:
        entry: The query.
        names: Names of the tensors.
        asked: The call; its tensors are those with gradients.
    """

    entry: Entry
    names: tuple[str, ...]
    asked: Asked

    def run(self, *plain: Any) -> Any:
        """The answer for tensors without gradients, given in the order of ``names``."""
        given = dict(zip(self.names, plain, strict=True))
        # Tensors that objects hold are no arguments.
        return self.entry.run(
            {
                name: given[name] if name in given else value if type(value) in PLAIN else untracked(value)
                for name, value in self.asked.arguments.items()
            }
        )


def hold(holder: Any, **tensors: Any) -> None:
    """Let the answers of an object's queries carry gradients with respect to these tensors."""
    object.__setattr__(holder, _HELD, tensors)


class Deferred:
    """An object of jax arrays, whose values are known when a query runs: in a callback.

    Queries of the object that is made take this one in its place, and rules read its attributes.
    """

    def made(self, **arrays: NDArray[Any]) -> Any:
        """The object of NumPy arrays in place of those that this one holds."""
        raise NotImplementedError

    def constant(self, held: dict[str, Any]) -> Any:
        """The same, of constants."""
        raise NotImplementedError

    def holding(self, held: dict[str, Any]) -> Any:
        """The same, of other arrays."""
        other: Any = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        hold(other, **held)
        return other


def split(values: Any) -> tuple[Any, Any]:
    """Values without gradients, and the tensor that carries gradients (None if there is none).

    An array of warp carries them whether a tape is recording or not: the tape may begin later.
    """
    if getattr(values, "requires_grad", False) is not True:
        return values, None
    if is_warp_array(values):
        return detached(values), values
    return (values.detach(), values) if _is_torch_tensor(values) else (values, None)


def held_by(holder: Any) -> dict[str, Any]:
    """The tensors with gradients that an object holds, by name; arrays of warp count while a tape is recording."""
    held: dict[str, Any] = getattr(holder, "__dict__", {}).get(_HELD) or {}
    if held and warp_private.tape_in_progress() is None:
        return {name: value for name, value in held.items() if not is_warp_array(value)}
    return held


def untracked(holder: Any) -> Any:
    """The object without the tensors that it holds; one that is made of them (:class:`Deferred`) has constants."""
    held = held_by(holder)
    if not held:
        return holder
    if isinstance(holder, Deferred):
        return holder.constant(held)
    plain: Any = object.__new__(type(holder))
    plain.__dict__.update({name: value for name, value in holder.__dict__.items() if name != _HELD})
    return plain


def refuse_gradients(name: str, value: Any) -> InputError:
    """The error for a tensor that requires gradients where the answer has none."""
    if is_warp_array(value):
        return refuse_recording(name)
    return InputError(f"{name}: a tensor that requires gradients, but answers carry none for it; detach it")


def require_constant(holder: Any, what: str) -> None:
    """Refuse an object that holds arrays of a tape, for an answer without gradients by them.

    torch has no need of it: there the answer has no graph, so that a backward pass fails.

    Raises:
        InputError: It holds such arrays, and a tape is recording.
    """
    for name, value in held_by(holder).items():
        if is_on_tape(value):
            raise InputError(
                f"{name}: a wp.Tape is recording, and {what} has no gradient by the array of {name} that the "
                f"{type(holder).__name__} holds; ask outside the tape, or make it of wp.clone(array, "
                "requires_grad=False). docs/gradients.md lists what has gradients"
            )


def is_tracked(value: Any) -> bool:
    """Whether a value is a tensor in a graph, a tracer, or an array whose gradient a tape of warp is recording."""
    if getattr(value, "requires_grad", False) is True:
        return _is_torch_tensor(value) or is_on_tape(value)
    jax = sys.modules.get("jax")
    return jax is not None and isinstance(value, jax.core.Tracer)


def is_on_tape(value: Any) -> bool:
    """Whether a value is an array of warp that requires gradients, while a tape is recording."""
    if getattr(value, "requires_grad", False) is not True or not is_warp_array(value):
        return False
    return warp_private.tape_in_progress() is not None


def _is_torch_tensor(value: Any) -> bool:
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def is_warp_array(value: Any) -> bool:
    """Whether a value is an array of warp."""
    warp = sys.modules.get("warp")
    return warp is not None and isinstance(value, warp.array)
