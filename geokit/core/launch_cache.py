"""Launches that are prepared once for each kernel and device, and then only given their arguments.

warp's own launch looks at the kernel, the module and every argument anew, which takes longer than most small kernels
run (25 us on an H100's host, for three arguments).
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from geokit.core.host_array import Described, unwrapped

if TYPE_CHECKING:
    import warp as wp

__all__ = ["run"]

STRUCT = object()

# Recorded launches that no thread is using.
_idle: dict[tuple[Any, str], list[_Recorded]] = {}


def run(kernel: Any, count: int, arguments: Sequence[Any], device: "wp.Device", block_dim: int) -> None:
    """Launch ``kernel`` for ``count`` items, as ``warp.launch`` does.

    Args:
        kernel: A kernel whose module is loaded. Of a generic one the arguments choose the overload, at each launch.
        count: Number of items, above 0.
        arguments: What it takes; something Described where an array is.
        device: Where to run it.
        block_dim: Threads of a block; the same for each launch of a kernel on a device.
    """
    if kernel.is_generic:
        _plain_launch(kernel, count, arguments, device, block_dim)
        return
    idle = _idle.setdefault((kernel, device.alias), [])
    try:
        recorded = idle.pop()
    except IndexError:
        recorded = _Recorded(kernel, count, arguments, device, block_dim)
    try:
        recorded.run(count, arguments)
    finally:
        idle.append(recorded)


def _plain_launch(
    kernel: Any, count: int, arguments: Sequence[Any], device: "wp.Device", block_dim: int, *, record: bool = False
) -> Any:
    import warp as wp

    given = [unwrapped(argument) for argument in arguments]
    return wp.launch(
        kernel, count, inputs=given, device=device, record_tape=False, record_cmd=record, block_dim=block_dim
    )


class _Recorded:
    """A launch of one thread at a time; it keeps no array alive."""

    __slots__ = ("_command", "_count", "_kinds")

    def __init__(self, kernel: Any, count: int, arguments: Sequence[Any], device: "wp.Device", block_dim: int) -> None:
        self._command = _plain_launch(kernel, count, arguments, device, block_dim, record=True)
        self._command.fwd_args = None  # it would keep the arguments alive
        self._count = count
        self._kinds = [_kind_of(argument.type) for argument in kernel.adj.args]

    def run(self, count: int, arguments: Sequence[Any]) -> None:
        import warp as wp

        command, array = self._command, wp.array
        parameters, addresses = command.params, command.params_addr
        for index, (kind, value) in enumerate(zip(self._kinds, arguments, strict=True), 1):
            passed = None
            if type(kind) is tuple:
                if isinstance(value, Described):
                    passed = value.descriptor
                elif type(value) is array and value.dtype is kind[0] and value.ndim == kind[1]:
                    passed = value.__ctype__()
            elif type(kind) is frozenset:
                if type(value) in kind:
                    parameters[index].value = value if type(value) in (int, float) else value.value
                    continue
            elif type(value) is kind:
                passed = value
            elif kind is STRUCT and hasattr(value, "__ctype__"):
                passed = value.__ctype__()
            if passed is None:  # not what the kernel expects: warp converts it, or says what is wrong
                command.set_param_at_index(index - 1, value)
                continue
            parameters[index] = passed
            if addresses is not None:  # of a GPU, whose kernels are given each argument's place
                addresses[index] = ctypes.addressof(passed)
        if count != self._count:
            command.set_dim(count)
            self._count = count
        command.launch()


def _kind_of(kind: Any) -> Any:
    """How an argument is passed on: (dtype, dimensions) of an array, types of a number that need no conversion, the
    type of a vector, or STRUCT."""
    import warp as wp

    if hasattr(kind, "ndim"):
        return kind.dtype, kind.ndim
    if kind in (wp.int32, wp.int64, wp.uint32, wp.uint64):
        return frozenset((int, kind))
    if kind in (wp.float32, wp.float64):
        return frozenset((float, int, kind))
    if not isinstance(kind, type):
        return STRUCT
    return kind if issubclass(kind, ctypes.Array) else None
