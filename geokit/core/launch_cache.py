"""Cache of prepared launches: one per kernel and device, where later calls only set the arguments.

``warp.launch`` inspects the kernel, its module and every argument anew. With three arguments that takes 25 us on an
H100's host, longer than most small kernels run.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from geokit.core.host_array import KernelArray, launch_argument

if TYPE_CHECKING:
    import warp as wp

__all__ = ["run"]

# Marks a kernel parameter that is a warp struct.
STRUCT = object()

# Recorded launches that no thread is using at the moment.
_idle: dict[tuple[Any, str], list[_Recorded]] = {}


def run(kernel: Any, count: int, arguments: Sequence[Any], device: "wp.Device", block_dim: int) -> None:
    """Launch ``kernel`` for ``count`` items, as ``warp.launch`` does.

    Args:
        kernel: A kernel whose module is loaded. For a generic kernel, each call goes to ``warp.launch``, which chooses
            the overload by the arguments.
        count: Number of items, above 0.
        arguments: The kernel's arguments. Arrays are warp arrays or KernelArrays.
        device: The device to run on.
        block_dim: Threads of a block; must be the same for each launch of a kernel on a device.
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

    given = [launch_argument(argument) for argument in arguments]
    return wp.launch(
        kernel, count, inputs=given, device=device, record_tape=False, record_cmd=record, block_dim=block_dim
    )


class _Recorded:
    """A recorded launch. One thread uses it at a time; it keeps no array alive."""

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
                if isinstance(value, KernelArray):
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
            if passed is None:  # not of the expected type: warp converts it, or names the mistake
                command.set_param_at_index(index - 1, value)
                continue
            parameters[index] = passed
            if addresses is not None:  # on a GPU, kernels are launched with the address of each argument
                addresses[index] = ctypes.addressof(passed)
        if count != self._count:
            command.set_dim(count)
            self._count = count
        command.launch()


def _kind_of(kind: Any) -> Any:
    """How arguments of a type are passed.

    Returns:
        (dtype, number of dimensions) for an array, the types that need no conversion for a number, the type itself for
        a vector, STRUCT for a struct, and None where warp has to convert.
    """
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
