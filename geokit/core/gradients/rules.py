"""Rules of gradients: how an answer depends on what was asked and on what an object holds.

A query searches once, without gradients. Its rule then has the closed form of the answer's derivative, so that a
backward pass searches nothing. A rule knows no library: it is written with the functions of a
:class:`~geokit.core.gradients.library.Library`. Torch and jax differentiate what it builds, where its ``adjoint`` does
not have the first derivatives; a tape of warp takes those of the adjoint, or of ``pull`` with NumPy.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.query import Query
from geokit.core.interop.arrays import detached, led
from geokit.core.launches import warp_private
from geokit.core.require import refuse_recording
from geokit.errors import InputError

if TYPE_CHECKING:
    import jax

# Attribute of an object (Surface, SparseVolume, NeighborGrid) that holds tensors with gradients.
_HELD = "_held_tensors"
# Types of options, which neither are tensors nor hold any.
PLAIN = frozenset((bool, int, float, str, type(None)))


class Rule(NamedTuple):
    """How an answer depends on tensors. To ``pull``, those of a tape of warp are arrays of NumPy.

    Attributes:
        build: ``build(library, asked, answer)`` gives each output again as a function of the tensors, or None where an
            output has no derivative. ``asked`` is a :class:`Asked`; ``answer`` is a tuple of tensors that count as
            constants. It may not search: torch differentiates it with tensors that have no memory.
        adjoint: ``adjoint(asked, answer, slopes, wanted, arrays)``: the wanted first derivatives, by name, by a
            kernel on the arrays where they lie; None where there is none for this call. All that are no tensors of
            objects lie on one device and are of one precision; ``arrays`` takes them to the kernel
            (:class:`~geokit.core.gradients.kernel_arrays.WarpArrays`). A slope is None where it is 0.
        pull: In place of ``build``: ``pull(library, asked, answer, slopes)`` gives the derivative with respect to each
            tensor in ``asked.tensors``, by name; ``slopes`` are those with respect to the outputs.
        has_slope: For each output, whether it has a derivative.
        is_traced: Whether jax can trace ``build`` or ``pull``; if not, it gets first derivatives as a tape does.
        at_once: ``at_once(asked)`` gives the answer to tensors of torch, a tuple, together with its derivative by each
            number of the first tensor, where one kernel finds both; None where none does. Of an answer (N,) to rows
            (N, 3), the derivative is (N, 3).
        check: ``check(asked)`` raises the error for a call without a derivative, for a tape of warp and for jax, which
            must know it before the answer.
        shapes: ``shapes(asked)`` gives shape and kind ("float" for that of the tensors, or "int32") of each output, for
            jax and torch.compile, which need them before the answer.
    """

    has_slope: tuple[bool, ...]
    build: Callable[..., tuple[Any, ...]] | None = None
    adjoint: Callable[..., dict[str, Any] | None] | None = None
    pull: Callable[..., dict[str, Any]] | None = None
    is_traced: bool = True
    at_once: Callable[[Asked], tuple[tuple[Any, ...], Any] | None] | None = None
    check: Callable[[Asked], object] | None = None
    shapes: Callable[..., list[tuple[tuple[int, ...], str]]] | None = None


class Asked(NamedTuple):
    """One call.

    Attributes:
        tensors: What the answer depends on, by name: tensors of the call and those that the object holds.
        arguments: All arguments by name, also the object under its parameter's name.
    """

    tensors: dict[str, Any]
    arguments: dict[str, Any]


class Call(NamedTuple):
    """A call of a query that is to carry gradients.

    Attributes:
        query: The query.
        names: Names of the tensors.
        asked: The call; its tensors are those with gradients.
    """

    query: Query
    names: tuple[str, ...]
    asked: Asked

    def run(self, *plain: Any) -> Any:
        """The answer for tensors without gradients, given in the order of ``names``."""
        given = dict(zip(self.names, plain, strict=True))
        # Tensors that objects hold are no arguments.
        return self.query.run(
            {
                name: given[name] if name in given else value if type(value) in PLAIN else untracked(value)
                for name, value in self.asked.arguments.items()
            }
        )


def owner_of(query: Query, name: str) -> tuple[str, str]:
    """The parameter whose object holds a tensor, and the tensor's name there."""
    holder, _, key = name.rpartition(".")
    return holder or query.parameters[0][0], key


def shaped(query: Query, answer: Any, lead: tuple[int, ...]) -> Any:
    """The answer with other leading axes, from that for a table of the rows; lists stay those of the table."""
    if query.is_ragged:
        return answer
    return led(answer, lead) if query.kind is None else query.kind(*(led(out, lead) for out in answer))


def hold(holder: Any, **tensors: Any) -> None:
    """Let the answers of an object's queries carry gradients with respect to these tensors."""
    object.__setattr__(holder, _HELD, tensors)


_Same = TypeVar("_Same", bound="Deferred")


class Deferred:
    """An object of jax arrays, whose values are known when a query runs: in a callback.

    Queries of the object that is made take this one in its place, and rules read its attributes.
    """

    def made(self, **arrays: NDArray[np.floating]) -> Any:
        """The object of NumPy arrays in place of those that this one holds."""
        raise NotImplementedError

    def constant(self: _Same, held: dict[str, jax.Array]) -> _Same:
        """The same, of constants."""
        raise NotImplementedError

    def holding(self: _Same, held: dict[str, jax.Array]) -> _Same:
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
    return (values.detach(), values) if is_torch_tensor(values) else (values, None)


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
        return is_torch_tensor(value) or is_on_tape(value)
    jax = sys.modules.get("jax")
    return jax is not None and isinstance(value, jax.core.Tracer)


def is_on_tape(value: Any) -> bool:
    """Whether a value is an array of warp that requires gradients, while a tape is recording."""
    if getattr(value, "requires_grad", False) is not True or not is_warp_array(value):
        return False
    return warp_private.tape_in_progress() is not None


def is_torch_tensor(value: Any) -> bool:
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def is_warp_array(value: Any) -> bool:
    """Whether a value is an array of warp."""
    warp = sys.modules.get("warp")
    return warp is not None and isinstance(value, warp.array)
