"""Cache of prepared launches: one per kernel and device, where later calls only set the arguments.

``warp.launch`` inspects the kernel, its module and every argument anew. With three arguments that takes 25 us on an
H100's host, longer than most small kernels run.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from geokit.core.launches import warp_private

if TYPE_CHECKING:
    import warp as wp

__all__ = ["KernelArray", "launch_argument", "run"]

# Marks a kernel parameter that is a warp struct.
STRUCT = object()

# Recorded launches that no thread is using at the moment.
_idle: dict[tuple[Any, str], Any] = {}
# In place of them for kernels that go to ``warp.launch`` each time.
PLAIN = ()


class KernelArray:
    """Base of the array types that :func:`geokit.core.launcher.launch` takes besides warp arrays."""

    __slots__ = ()

    if TYPE_CHECKING:  # not an ABC, whose isinstance check takes four times as long

        @property
        def descriptor(self) -> Any:
            """Warp's array descriptor: address, shape and strides."""

        @property
        def warp(self) -> "wp.array":
            """A warp array over the same memory."""


def launch_argument(argument: Any) -> Any:
    """Replace a KernelArray by its descriptor; return any other kernel argument unchanged."""
    if not isinstance(argument, KernelArray):
        return argument
    return argument.descriptor if warp_private.descriptor_type() else argument.warp


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
    idle = _idle.get((kernel, device.alias))
    if idle is None:
        idle = _idle.setdefault((kernel, device.alias), [] if warp_private.is_packed(kernel) else PLAIN)
    if idle is PLAIN:
        _plain_launch(kernel, count, arguments, device, block_dim)
        return
    try:
        recorded = idle.pop()
    except IndexError:
        recorded = _Recorded(kernel, count, arguments, device, block_dim)
    try:
        recorded.run(count, arguments)
    finally:
        idle.append(recorded)


def _plain_launch(kernel: Any, count: int, arguments: Sequence[Any], device: "wp.Device", block_dim: int) -> None:
    import warp as wp

    given = [launch_argument(argument) for argument in arguments]
    wp.launch(kernel, count, inputs=given, device=device, record_tape=False, block_dim=block_dim)


class _Recorded:
    """A recorded launch. One thread uses it at a time; it keeps no array alive."""

    __slots__ = ("_addresses", "_command", "_count", "_kinds", "_parameters")

    def __init__(self, kernel: Any, count: int, arguments: Sequence[Any], device: "wp.Device", block_dim: int) -> None:
        given = [launch_argument(argument) for argument in arguments]
        self._command = warp_private.record_launch(kernel, count, given, device, block_dim)
        self._parameters, self._addresses = warp_private.packed_parameters(self._command)
        self._count = count
        self._kinds = [_kind_of(kind) for _, kind in warp_private.parameters(kernel) or ()]

    def run(self, count: int, arguments: Sequence[Any]) -> None:
        import warp as wp

        command, array = self._command, wp.array
        parameters, addresses = self._parameters, self._addresses
        for index, (kind, value) in enumerate(zip(self._kinds, arguments, strict=True), 1):
            passed = None
            if type(kind) is tuple:
                if isinstance(value, KernelArray):
                    passed = value.descriptor
                elif type(value) is array and value.dtype is kind[0] and value.ndim == kind[1]:
                    passed = warp_private.descriptor_of(value)
            elif type(kind) is frozenset:
                if type(value) in kind:
                    parameters[index].value = value if type(value) in (int, float) else value.value
                    continue
            elif type(value) is kind:
                passed = value
            elif kind is STRUCT and warp_private.is_struct(value):
                passed = warp_private.descriptor_of(value)
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
