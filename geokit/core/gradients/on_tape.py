"""Gradients on a tape of warp: queries record what takes the gradients of their answers to those of their arguments.

A backward pass reads arrays where they are then, as those of warp's own launches do: what is overwritten between the
query and the pass has its new values. It adds to the gradients of arguments, and consumes those of answers: a second
pass over a tape adds as much again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from geokit.core.base.snapshot import snapshot
from geokit.core.gradients.kernel_arrays import add_to
from geokit.core.gradients.rules import Asked, Call, is_tracked, untracked
from geokit.core.gradients.with_numpy import pulled
from geokit.core.interop.arrays import detached
from geokit.core.launches import warp_private
from geokit.core.require import read_array
from geokit.errors import InputError


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

    def back(slopes: list[Any]) -> list[Any]:
        asked = Asked({name: detached(array) for name, array in arrays.items()}, others)
        found = pulled(call.query, asked, outputs, slopes, list(wanted))
        return [found[name] for name in wanted]

    record(list(wanted.values()), list(outputs), rule.has_slope, back, ", ".join(call.names))
    return given


def record(
    inputs: list[Any], outputs: list[Any], has_slope: Any, back: Callable[[list[Any]], list[Any]], names: str
) -> None:
    """Record the way back from outputs to inputs.

    Args:
        inputs, outputs: Arrays of warp.
        has_slope: For each output, whether it has a derivative.
        back: Takes the slopes of the outputs (None where they are 0) to those of the inputs, of warp or of NumPy.
        names: Of the inputs.
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
        slopes = [None if out is None else out.grad for out in sloped]
        if all(slope is None for slope in slopes):
            return
        for array, part in zip(inputs, back(slopes), strict=True):
            add_to(array, part)
        for out in carrying:
            # As warp zeroes those of what a kernel wrote to.
            if out.grad is not None and not out.retain_grad:
                out.grad.zero_()

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
