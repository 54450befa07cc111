"""Gradients on a tape of warp: queries record what takes the gradients of their answers to those of their arguments.

A backward pass reads arrays where they are then, as those of warp's own launches do: what is overwritten between the
query and the pass has its new values. It adds to the gradients of arguments, and consumes those of answers: a second
pass over a tape adds as much again. Arrays of a GPU go by way of the host, except where a rule has a kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from geokit.core.base.snapshot import snapshot
from geokit.core.gradients.kernel_arrays import add_to, pulled_by_kernel
from geokit.core.gradients.rules import Asked, Call, is_tracked, untracked
from geokit.core.gradients.with_numpy import Followed, plain, pulled, pulled_back
from geokit.core.interop.arrays import detached
from geokit.core.launches import warp_private
from geokit.core.require import read_array
from geokit.errors import InputError

__all__ = ["attach", "derived"]


def attach(call: Call) -> Any:
    """Answer a call with arrays that carry gradients, and record the way back."""
    tensors = call.asked.tensors
    like = next(value for value in tensors.values() if isinstance(value, wp.array))
    arrays = {name: _array(tensors[name], name, like) for name in call.names}
    _refuse_capture(list(arrays.values()), ", ".join(call.names))
    rule = call.query.rule()
    # Objects as they are now: they may be updated before the backward pass.
    others = {name: _kept(value) for name, value in call.asked.arguments.items() if name not in arrays}
    if rule.check is not None:
        rule.check(Asked(arrays, {**others, **arrays}))
    given = call.run(*map(detached, arrays.values()))
    outputs = given if isinstance(given, tuple) else (given,)
    wanted = {name: array for name, array in arrays.items() if array.requires_grad}

    def on_device(slopes: list[Any]) -> bool:
        totals = {name: array.grad for name, array in wanted.items()}
        if not all(total.size and total.is_contiguous for total in totals.values()):
            return False
        asked = Asked({name: detached(array) for name, array in arrays.items()}, others)
        found = pulled_by_kernel(call.query, asked, outputs, slopes, list(wanted))
        for name, part in (found or {}).items():
            add_to(totals[name], part)
        return found is not None

    def back(slopes: list[Any]) -> list[NDArray[Any]]:
        tensors = {name: _rows(array) for name, array in arrays.items()}
        inputs = {name: part for name, part in tensors.items() if name in call.query.inputs}
        answer = [_rows(out) for out in outputs]
        found = pulled(call.query, Asked(tensors, {**others, **inputs}), answer, slopes, list(wanted))
        return [found[name] for name in wanted]

    _record(list(wanted.values()), list(outputs), rule.has_slope, back, ", ".join(call.names), on_device)
    return given


def derived(build: Callable[..., Any], *arrays: Any) -> Any:
    """Numbers that depend on arrays of a tape, as arrays that carry gradients; one number has the shape (1,).

    Args:
        build: Makes a NamedTuple, which may hold others, of :class:`geokit.core.gradients.with_numpy.Followed` values
            of the arrays that carry gradients, and of NumPy arrays.
        arrays: Arrays of warp.
    """
    tracked = [array for array in arrays if array.requires_grad]

    def built() -> tuple[Any, list[Any], list[Any]]:
        given = [Followed(_rows(array)) if array.requires_grad else _rows(array) for array in arrays]
        found = build(*given)
        return found, _leaves(found), [one for one in given if isinstance(one, Followed)]

    def back(slopes: list[Any]) -> list[NDArray[Any]]:
        _, leaves, sources = built()
        return pulled_back(leaves, slopes, sources)

    found, leaves, _ = built()
    outputs = [_number(leaf, arrays[0]) for leaf in leaves]
    _record(tracked, outputs, [isinstance(leaf, Followed) for leaf in leaves], back, "points")
    return _with_leaves(found, iter(outputs))


def _record(
    inputs: list[Any],
    outputs: list[Any],
    has_slope: Any,
    back: Callable[[list[Any]], list[NDArray[Any]]],
    names: str,
    on_device: Callable[[list[Any]], bool] = lambda _: False,
) -> None:
    """Record the way back from outputs to inputs.

    Args:
        inputs, outputs: Arrays of warp.
        has_slope: For each output, whether it has a derivative.
        back: Takes the slopes of the outputs (None where they are 0) to those of the inputs, on the host.
        names: Of the inputs.
        on_device: Adds the same to the gradients of the inputs on their device, and returns whether it could.
    """
    tape = warp_private.tape_in_progress()
    if isinstance(tape, str):
        raise InputError(
            f"{names}: a wp.Tape is recording, and warp {wp.__version__} does not say which; query outside the tape"
        )
    sloped = [out if some and out.size else None for out, some in zip(outputs, has_slope, strict=True)]
    carrying = [out for out in sloped if out is not None]
    if not carrying:
        return
    for out in carrying:
        out.requires_grad = True

    def backward() -> None:
        _refuse_capture([*inputs, *carrying], names)
        if on_device([None if out is None else out.grad for out in sloped]):
            for out in carrying:
                _consume(out)
            return
        slopes = [None if out is None else _consumed(out) for out in sloped]
        if any(slope is not None for slope in slopes):
            for array, part in zip(inputs, back(slopes), strict=True):
                _add_to(array, part)

    tape.record_func(backward, [*(array for array in inputs if array.size), *carrying])
    if wp.config.verify_autograd_array_access:
        for array in inputs:
            array.mark_read()


def _refuse_capture(arrays: list[Any], names: str) -> None:
    if any(array.device.is_capturing for array in arrays):
        raise InputError(
            f"{names}: a graph is being captured, which would not hold what a query or its gradients do on the host; "
            "query, and go back over the tape, outside the capture"
        )


def _array(values: Any, name: str, like: Any) -> Any:
    if is_tracked(values) and not isinstance(values, wp.array):
        raise InputError(f"{name}: a tensor with gradients beside arrays on a wp.Tape; give all of one library")
    if not isinstance(values, wp.array):
        rows = read_array(values, name)
        kind = wp.float32 if rows.dtype == np.float32 else wp.float64
        return wp.array(rows, dtype=kind, device=like.device)
    if values.requires_grad and values.dtype not in (wp.float32, wp.float64, wp.vec3f, wp.vec3d):
        kind = getattr(values.dtype, "__name__", str(values.dtype))
        raise InputError(f"{name}: {kind} has no gradients; give float32 or float64")
    return values


def _kept(value: Any) -> Any:
    """An argument as it is now: an object as of its last update, without what it holds; an array on the host."""
    if isinstance(value, wp.array):
        return value.numpy().copy()
    kept = untracked(value)
    return snapshot(kept) if kept is value and hasattr(value, "update") and hasattr(value, "_cache") else kept


def _rows(array: Any) -> NDArray[Any]:
    """An array on the host, numbers in float64; a row for each vector."""
    values: NDArray[Any] = array.numpy()
    return values.astype(np.float64) if values.dtype.kind == "f" else values


def _consumed(out: Any) -> NDArray[np.float64] | None:
    """The gradient of an output, which is zeroed as warp zeroes what a kernel wrote to; None if it is 0."""
    if out.grad is None:
        return None
    slope = _rows(out.grad)
    if not slope.any():
        return None
    _consume(out)
    return slope


def _consume(out: Any) -> None:
    if not out.retain_grad:
        out.grad.zero_()


def _add_to(array: Any, part: NDArray[Any]) -> None:
    grad = array.grad
    if grad is None or not array.size:
        return
    before = grad.numpy()
    grad.assign((before + part.reshape(before.shape)).astype(before.dtype))


def _leaves(found: Any) -> list[Any]:
    return [leaf for one in found for leaf in (_leaves(one) if isinstance(one, tuple) else [one])]


def _with_leaves(found: Any, leaves: Any) -> Any:
    return type(found)(*(_with_leaves(one, leaves) if isinstance(one, tuple) else next(leaves) for one in found))


def _number(leaf: Any, like: Any) -> Any:
    values = np.atleast_1d(plain(leaf))
    kind = like.dtype if values.dtype.kind == "f" else wp.int32
    return wp.array(values, dtype=kind, device=like.device)
