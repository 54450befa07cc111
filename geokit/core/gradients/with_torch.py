"""Gradients through torch."""

from __future__ import annotations

import inspect
import math
from typing import Any

import torch

from geokit.core.base.query import Query
from geokit.core.base.snapshot import snapshot
from geokit.core.gradients.library import Library
from geokit.core.gradients.rules import Asked, Call, Rule, untracked
from geokit.core.gradients.tensor_rows import TensorArrays
from geokit.core.launches.late_checks import AtEnd
from geokit.core.require import read_array
from geokit.errors import InputError

# Whether torch.func transforms what runs; all calls count as transformed where torch does not tell.
_is_transformed = getattr(torch._C, "_are_functorch_transforms_active", lambda: True)
# The hooks that watch what graphs keep, if there are any: of checkpoints, or to move it to the host.
_watching = getattr(torch._C._autograd, "_top_saved_tensors_default_hooks", lambda _: None)


def attach(call: Call) -> Any:
    """Answer a call with tensors that carry gradients."""
    given = call.asked.tensors
    like = next(value for value in given.values() if isinstance(value, torch.Tensor))
    tensors = [_tensor(given[name], name, like) for name in call.names]
    if len(tensors) > 1 and len({tensor.device for tensor in tensors}) > 1:
        devices = {str(tensor.device) for tensor in tensors}
        raise InputError(f"{', '.join(call.names)}: tensors on {', '.join(sorted(devices))}; move them to one device")
    for name, tensor in zip(call.names, tensors, strict=True):
        if tensor.dtype not in (torch.float32, torch.float64):
            raise InputError(f"{name}: {tensor.dtype} has no gradients; give float32 or float64")
        if tensor.is_meta:
            raise InputError(f"{name}: a tensor on the meta device holds no numbers; give one with memory")
    if _is_transformed():
        answer = _Query.apply(call, *tensors)
    else:
        # A GPU is at work while the graph is made.
        with AtEnd():
            answer = _answered(call, tensors)
    return answer[0] if call.query.kind is None else call.query.kind(*answer)


def _answered(call: Call, tensors: list[Any]) -> Any:
    plain = [tensor.detach() for tensor in tensors]
    if not torch.is_grad_enabled():
        return _tuple_of(call.run(*plain))
    rule, first = call.query.rule(), call.query.parameters[0][0]
    asked = call.asked._replace(arguments=dict(call.asked.arguments))
    if hasattr(asked.arguments[first], "update") and hasattr(asked.arguments[first], "_cache"):
        # The backward pass is that of the object as it is now.
        asked.arguments[first] = snapshot(asked.arguments[first])
    found = None
    # Who watches what a graph keeps gets no more than the arguments and the answer, in each call the same.
    if rule.at_once is not None and _watching(True) is None:
        found = rule.at_once(asked._replace(tensors=dict(zip(call.names, plain, strict=True))))
    answer, kept = found or (_tuple_of(call.run(*plain)), None)
    return _Attached.apply(call._replace(asked=asked), answer, kept, *tensors)


def _tuple_of(answer: Any) -> tuple[Any, ...]:
    return tuple(answer) if isinstance(answer, tuple) else (answer,)


def by_kernel(query: Query, asked: Asked, answer: Any, slopes: Any, wanted: list[str]) -> dict[str, Any] | None:
    """The same as :func:`pulled` by one kernel, where there is one and nothing is differentiated further."""
    adjoint = query.rule().adjoint
    if adjoint is None or torch.is_grad_enabled() or _is_transformed() or not _have_memory(slopes):
        return None
    rows = [asked.tensors[name] for name in query.inputs if name in asked.tensors]
    given = [*rows, *(out for out in (*answer, *slopes) if out is not None and out.is_floating_point())]
    if any(one.dtype != given[0].dtype or one.device != given[0].device for one in given):
        return None
    found = adjoint(asked, answer, slopes, wanted, TensorArrays(given[0], _Add.forward))
    return found and {name: part.reshape(asked.tensors[name].shape) for name, part in found.items()}


def _have_memory(slopes: Any) -> bool:
    """Whether a kernel can read them; batches of torch's vmap have no memory of their own."""
    try:
        for slope in slopes:
            if slope is not None:
                slope.data_ptr()
    except RuntimeError:
        return False
    return True


def pulled(rule: Rule, asked: Asked, answer: Any, slopes: Any, wanted: list[str]) -> dict[str, Any]:
    """Derivatives with respect to the tensors ``wanted``, from those with respect to the answer, by name."""
    if not torch.is_grad_enabled():
        # Nothing is differentiated further: the searches of this pass are plain ones.
        plain = {name: tensor.detach() for name, tensor in asked.tensors.items()}
        arguments = {name: plain.get(name, untracked(value)) for name, value in asked.arguments.items()}
        asked = asked._replace(tensors=plain, arguments=arguments)
    slopes = [torch.zeros_like(out) if slope is None else slope for out, slope in zip(answer, slopes, strict=True)]
    if rule.pull is not None:
        return rule.pull(LIBRARY, asked, answer, slopes)
    build: Any = rule.build

    def outputs(*some: Any) -> tuple[Any, ...]:
        # In float64 throughout, as the search itself.
        given = {**asked.tensors, **dict(zip(wanted, some, strict=True))}
        built = build(LIBRARY, asked._replace(tensors={name: value.double() for name, value in given.items()}), answer)
        return tuple(out for out in built if out is not None)

    tensors = [asked.tensors[name] for name in wanted]
    wide = tuple(slope.double() for slope, some in zip(slopes, rule.has_slope, strict=True) if some)
    found = None
    if not torch.is_grad_enabled() and not _is_transformed():
        # torch.func, at its first call, imports torch's compiler, which takes 0.7 s.
        found = _pulled_plainly(outputs, tensors, wide)
    if found is None:
        found = torch.func.vjp(outputs, *tensors)[1](wide)
    return dict(zip(wanted, found, strict=True))


def _pulled_plainly(outputs: Any, tensors: list[Any], slopes: Any) -> Any:
    """Derivatives that are not differentiated further; None where an output has no graph, as while torch.compile traces
    this pass."""
    tensors = [tensor.detach().requires_grad_() for tensor in tensors]
    with torch.enable_grad():
        built = outputs(*tensors)
    if not all(out.requires_grad for out in built):
        return None
    return torch.autograd.grad(built, tensors, slopes, allow_unused=True, materialize_grads=True)


def _tensor(values: Any, name: str, like: Any) -> Any:
    return values if isinstance(values, torch.Tensor) else torch.tensor(read_array(values, name), device=like.device)


def _keep(ctx: Any, call: Call, tensors: Any, answer: Any, kept: Any) -> None:
    """Keep for the backward pass what was asked and found, and the derivative by the first tensor, if it is known."""
    ctx.call, ctx.outputs = call, len(answer)
    ctx.set_materialize_grads(False)
    has_slope = call.query.rule().has_slope
    ctx.mark_non_differentiable(*(out for out, some in zip(answer, has_slope, strict=True) if not some))
    ctx.save_for_backward(*tensors, *answer, *(() if kept is None else (kept,)))


def _pulled_back(ctx: Any, slopes: Any) -> list[Any]:
    """The derivative by each tensor; None where it is not wanted."""
    call: Call = ctx.call
    count = len(call.names)
    try:
        saved = ctx.saved_tensors
    except RuntimeError as error:
        if "a second time" not in str(error):  # such as a tensor that was changed in place
            raise
        raise InputError(
            f"{', '.join(call.names)}: an earlier backward pass has freed what this one needs; give that one "
            "retain_graph=True, or ask the query again"
        ) from error
    tensors, answer, kept = saved[:count], saved[count : count + ctx.outputs], saved[count + ctx.outputs :]
    if kept and not torch.is_grad_enabled() and slopes[0] is not None:
        return [slopes[0][:, None] * kept[0]]
    wanted = [name for name, need in zip(call.names, ctx.needs_input_grad[-count:], strict=True) if need]
    asked = call.asked._replace(tensors=dict(zip(call.names, tensors, strict=True)))
    rule = call.query.rule()
    found = by_kernel(call.query, asked, answer, slopes, wanted)
    if found is None:
        found = pulled(rule, asked, [output.detach() for output in answer], slopes, wanted)
    of = zip(call.names, tensors, strict=True)
    return [found[name].to(tensor.dtype) if name in wanted else None for name, tensor in of]


class _Query(torch.autograd.Function):
    """One search, and the derivative of its answer by the call's rule."""

    generate_vmap_rule = False

    @staticmethod
    def forward(call: Call, *tensors: Any) -> Any:
        return _tuple_of(call.run(*(tensor.detach() for tensor in tensors)))

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        call, *tensors = inputs
        _keep(ctx, call, tensors, output, None)

    @staticmethod
    def backward(ctx: Any, *slopes: Any) -> Any:
        return (None, *_pulled_back(ctx, slopes))

    @staticmethod
    def vmap(info: Any, in_dims: Any, call: Call, *tensors: Any) -> Any:
        """All batches as the rows of one call."""
        size, flat = info.batch_size, []
        for name, tensor, dim in zip(call.names, tensors, in_dims[1:], strict=True):
            is_held = name not in call.asked.arguments
            if is_held and dim is not None:
                raise InputError(f"{name}: vmap over what an object holds is not supported; loop over the objects")
            if not is_held:
                batch = tensor.expand(size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
                tensor = batch.reshape(-1, *batch.shape[2:])
            flat.append(tensor)
        answer = _Query.apply(call, *flat)
        return tuple(out.reshape(size, -1, *out.shape[1:]) for out in answer), tuple(0 for _ in answer)


class _Attached(torch.autograd.Function):
    """An answer that is known, and its derivative by the call's rule."""

    @staticmethod
    def forward(ctx: Any, call: Call, answer: Any, kept: Any, *tensors: Any) -> Any:
        _keep(ctx, call, tensors, answer, kept)
        return answer

    @staticmethod
    def backward(ctx: Any, *slopes: Any) -> Any:
        return (None, None, None, *_pulled_back(ctx, slopes))


# Torch asks for the signature in each call, and to find it takes longer than all else there.
_Query.forward.__signature__ = inspect.signature(_Query.forward)  # type: ignore[attr-defined]


class _Take(torch.autograd.Function):
    """Rows of a table; backward is :class:`_Add`."""

    generate_vmap_rule = True

    @staticmethod
    def forward(table: Any, index: Any) -> Any:
        return table[index]

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        table, index = inputs
        ctx.rows = table.shape[0]
        ctx.save_for_backward(index)

    @staticmethod
    def backward(ctx: Any, slope: Any) -> Any:
        (index,) = ctx.saved_tensors
        return _Add.apply(slope, index, ctx.rows), None


class _Add(torch.autograd.Function):
    """Sums of the rows of each index, in the order of the rows; backward is :class:`_Take`."""

    generate_vmap_rule = True

    @staticmethod
    def forward(rows: Any, index: Any, count: int) -> Any:
        flat = rows.reshape(index.numel(), math.prod(rows.shape[index.ndim :]))
        places = index.reshape(-1)
        if rows.is_cuda:
            # index_add_ adds in any order there.
            order = torch.argsort(places, stable=True)
            lengths = torch.bincount(places, minlength=count)
            total = torch.segment_reduce(flat[order], "sum", lengths=lengths, axis=0, unsafe=True)
        else:
            total = torch.zeros(count, flat.shape[1], dtype=rows.dtype).index_add_(0, places, flat)
        return total.reshape(count, *rows.shape[index.ndim :])

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.save_for_backward(inputs[1])

    @staticmethod
    def backward(ctx: Any, slope: Any) -> Any:
        (index,) = ctx.saved_tensors
        return _Take.apply(slope, index), None, None


def _take(table: Any, index: Any) -> Any:
    return _Take.apply(table, index) if torch.is_grad_enabled() else _Take.forward(table, index)


def _add(rows: Any, index: Any, count: int) -> Any:
    return _Add.apply(rows, index, count) if torch.is_grad_enabled() else _Add.forward(rows, index, count)


def _constant(values: Any, like: Any) -> Any:
    """An array as a tensor on the device of another; whole numbers as int64, which indexes."""
    tensor = values if isinstance(values, torch.Tensor) else torch.tensor(values, device=like.device)
    return tensor.double() if tensor.is_floating_point() else tensor.long() if tensor.dtype != torch.bool else tensor


def _kept(cache: Any, name: str, values: Any, like: Any) -> Any:
    return cache.find((name, str(like.device)), lambda: _constant(values, like))


class _Once(torch.autograd.Function):
    """A tensor whose backward pass raises an error with the given message."""

    @staticmethod
    def forward(message: str, tensor: Any, *of: Any) -> Any:
        return tensor.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.message = inputs[0]

    @staticmethod
    def backward(ctx: Any, slope: Any) -> Any:
        raise InputError(ctx.message)


def _once(tensor: Any, message: str, of: dict[str, Any]) -> Any:
    # Nothing is differentiated further unless a graph is made of the backward pass.
    if not torch.is_grad_enabled():
        return tensor
    return _Once.apply(message, tensor, *of.values())


LIBRARY = Library(
    where=torch.where,
    sqrt=torch.sqrt,
    floor=torch.floor,
    stack=torch.stack,
    take=_take,
    add=_add,
    constant=_constant,
    kept=_kept,
    wide=lambda tensor: tensor.double(),
    whole=lambda tensor: tensor.long(),
    listed=lambda offsets, total: torch.repeat_interleave(offsets.diff(), output_size=total),
    detach=lambda tensor: tensor.detach(),
    ask=lambda query, points, shape, *beside: query(points, *beside),
    once=_once,
)
