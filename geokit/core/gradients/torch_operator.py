"""Queries as operators of torch, which torch.compile keeps whole in its graphs.

An operator takes tensors and numbers only. So each query with its object and options has a number, given while
torch.compile traces; the guards of torch see to it that another object is traced anew.
"""

from __future__ import annotations

import ctypes
import weakref
from typing import Any, NamedTuple

import torch

from geokit.core.base.query import Query
from geokit.core.gradients.rules import Asked, shaped, untracked
from geokit.core.gradients.with_torch import by_kernel, pulled
from geokit.errors import InputError


class _Known(NamedTuple):
    """A query and its arguments that are not tensors; objects are held by weak references."""

    query: Query
    names: tuple[str, ...]
    others: dict[str, Any]

    def asked(self, tensors: list[Any]) -> Asked:
        others = {name: value() if isinstance(value, weakref.ref) else value for name, value in self.others.items()}
        given = dict(zip(self.names, tensors, strict=True))
        return Asked(given, {**others, **given})


_known: list[_Known] = []


@torch._dynamo.assume_constant_result
def _number(query: int, names: tuple[str, ...], holders: tuple[Any, ...], options: tuple[Any, ...]) -> int:
    """The number of a query and its objects, which are passed as addresses; the caller keeps them alive."""
    others = dict(options)
    others.update({name: weakref.ref(_at(address)) for name, address in holders})
    _known.append(_Known(_at(query), names, others))
    return len(_known) - 1


def _at(address: int) -> Any:
    return ctypes.cast(address, ctypes.py_object).value


def traced(query: Query, args: Any, kwargs: Any) -> Any:
    """Answer a call while torch.compile traces it."""
    names: tuple[str, ...] = ()
    holders: tuple[Any, ...] = ()
    options: tuple[Any, ...] = ()
    tensors: list[Any] = []
    lead: tuple[int, ...] | None = None
    for place, (name, default) in enumerate(query.parameters):
        value = args[place] if place < len(args) else kwargs.get(name, default)
        if isinstance(value, torch.Tensor):
            if name in query.inputs and value.dtype not in (torch.float32, torch.float64):
                value = value.double()
            if name == "directions" and value.ndim == 1 and "origins" in names:  # one for all
                value = value.expand(tensors[names.index("origins")].shape)
            elif query.is_single and name in query.inputs and value.ndim != 2:
                lead, value = value.shape[:-1], value.reshape(-1, 3)
            names, tensors = (*names, name), [*tensors, value]
        elif value is None or isinstance(value, (bool, int, float, str)):
            options = (*options, (name, value))
        elif isinstance(value, (list, tuple)) and all(isinstance(number, (bool, int, float)) for number in value):
            options = (*options, (name, tuple(value)))
        else:
            holders = (*holders, (name, id(value)))
            held = value.__dict__.get("_held_tensors") if place == 0 or name in query.holders else None
            if held is not None:
                for key in held:
                    names = (*names, key if place == 0 else f"{name}.{key}")
                    tensors = [*tensors, held[key]]
    answer = torch.ops.geokit.answer(tensors, _number(id(query), names, holders, options))
    answer = answer[0] if query.kind is None else query.kind(*answer)
    return answer if lead is None else shaped(query, answer, lead)


@torch.library.custom_op("geokit::answer", mutates_args=())
def _answer(tensors: list[torch.Tensor], call: int) -> list[torch.Tensor]:
    known = _known[call]
    asked = known.asked([tensor.detach() for tensor in tensors])
    given = {name: untracked(value) for name, value in asked.arguments.items() if name in dict(known.query.parameters)}
    answer = known.query.run(given)
    return list(answer) if isinstance(answer, tuple) else [answer]


@_answer.register_fake
def _(tensors: list[torch.Tensor], call: int) -> list[torch.Tensor]:
    known = _known[call]
    shapes = known.query.rule().shapes
    if shapes is None:
        raise InputError("this answer has no shape before it is known; call it outside of torch.compile")
    kinds = {"float": tensors[0].dtype, "int32": torch.int32}
    return [tensors[0].new_empty(shape, dtype=kinds[kind]) for shape, kind in shapes(known.asked(tensors))]


@torch.library.custom_op("geokit::pull", mutates_args=())
def _pull(
    tensors: list[torch.Tensor], answer: list[torch.Tensor], slopes: list[torch.Tensor], call: int
) -> list[torch.Tensor]:
    known = _known[call]
    asked = known.asked(tensors)
    # Other parameters, such as offsets, may be tensors too.
    others = {name for name, _ in known.query.parameters} - set(known.query.inputs)
    wanted = [name for name in known.names if name not in others]
    asked = asked._replace(tensors={name: asked.tensors[name] for name in wanted})
    rule = known.query.rule()
    found = by_kernel(known.query, asked, answer, slopes, wanted)
    if found is None:
        found = pulled(rule, asked, answer, slopes, wanted)
    given = zip(known.names, tensors, strict=True)
    return [found[name].to(tensor.dtype) if name in wanted else torch.zeros_like(tensor) for name, tensor in given]


@_pull.register_fake
def _(
    tensors: list[torch.Tensor], answer: list[torch.Tensor], slopes: list[torch.Tensor], call: int
) -> list[torch.Tensor]:
    return [torch.empty_like(tensor) for tensor in tensors]


def _keep(ctx: Any, inputs: Any, output: Any) -> None:
    tensors, ctx.call = inputs
    ctx.count = len(tensors)
    ctx.save_for_backward(*tensors, *output)
    ctx.mark_non_differentiable(*(out for out in output if not out.is_floating_point()))


def _backward(ctx: Any, slopes: Any) -> Any:
    saved = list(ctx.saved_tensors)
    answer = saved[ctx.count :]
    # An operator takes no None.
    slopes = [torch.zeros_like(out) if slope is None else slope for out, slope in zip(answer, slopes, strict=True)]
    return torch.ops.geokit.pull(saved[: ctx.count], answer, slopes, ctx.call), None


_answer.register_autograd(_backward, setup_context=_keep)
