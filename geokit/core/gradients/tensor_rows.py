"""Tensors of torch as arguments of kernels, where they lie, on the stream on which torch works."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.interop.arrays import is_in_order
from geokit.core.launches.warp_private import KernelArray
from geokit.core.memory.host_array import array_descriptor


class TensorRows(KernelArray):
    """Numbers (N,), or rows (N, 3) that a kernel takes as vectors; the tensor that a strided one is copied to is kept.

    To make a warp array of a tensor takes as long as a launch; this takes a fifth of that.
    """

    __slots__ = ("_descriptor", "_tensor")

    def __init__(self, tensor: Any) -> None:
        if tensor.is_neg():
            tensor = tensor.resolve_neg()
        if tensor.ndim == 2 and tensor.stride(1) != 1:
            tensor = tensor.contiguous()
        self._tensor = tensor
        self._descriptor: Any = None

    def __len__(self) -> int:
        return len(self._tensor)

    @property
    def descriptor(self) -> Any:
        if self._descriptor is None:
            tensor = self._tensor
            self._descriptor = array_descriptor(tensor.data_ptr(), tuple(tensor.shape[:1]), 0)
            self._descriptor.strides[0] = tensor.stride(0) * tensor.element_size()
        return self._descriptor

    @property
    def warp(self) -> "wp.array":
        """A warp array over the same memory."""
        number = number_of(self._tensor)
        vector = wp.vec3d if number is wp.float64 else wp.vec3f
        array: Any = wp.from_torch(self._tensor.detach(), dtype=vector if self._tensor.ndim == 2 else number)
        return array


class TensorArrays:
    """What the kernel of a derivative works on; as :class:`geokit.core.gradients.kernel_arrays.WarpArrays`."""

    def __init__(self, like: Any, add: Any) -> None:
        """``add(rows, index, count)`` gives the sums of the rows of each index."""
        self.device, self.number, self._like, self._add = device_of(like), number_of(like), like, add

    def given(self, values: Any, width: int = 1) -> Any:
        """Values as an argument of a kernel: numbers, or rows of ``width`` 3; None is an array without rows."""
        if values is None:
            values = self._like.new_empty((0, 3) if width == 3 else 0)
        return TensorRows(values.reshape(-1, 3) if width == 3 else values.reshape(-1))

    def made(self, count: int, width: int, number: Any = None) -> Any:
        """A new tensor of ``count`` numbers or rows, of the coordinates' type if no other is given."""
        kind = {wp.float64: torch.float64, wp.int32: torch.int32, wp.int64: torch.int64, None: self._like.dtype}[number]
        return self._like.new_empty((count, 3) if width == 3 else count, dtype=kind)

    def launch(self, kernel: Any, count: int, inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
        """Run a kernel; outputs are tensors that :meth:`made` gave."""
        launch(kernel, count, inputs, list(map(TensorRows, outputs)), self.device)

    def added(self, rows: Any, index: Any, count: int) -> Any:
        """The sums (count, 3) of the rows of each index, in the order of the rows: the same bits in every run."""
        return self._add(rows, index, count) if len(rows) else rows.new_zeros((count, 3))


def device_of(tensor: Any) -> "wp.Device":
    """The device of a tensor."""
    return wp.device_from_torch(tensor.device)


def number_of(tensor: Any) -> Any:
    """The type of a tensor's numbers in kernels."""
    known = {torch.float32: wp.float32, torch.float64: wp.float64, torch.int32: wp.int32, torch.int64: wp.int64}
    return known[tensor.dtype]


def launch(kernel: Any, count: int, inputs: Sequence[Any], outputs: Sequence[Any], device: "wp.Device") -> None:
    """Run a kernel as :func:`geokit.core.launcher.launch` does, in order with what torch does on its current stream."""
    if is_in_order(torch, device):
        launcher.launch(kernel, count, inputs, outputs, device)
        return
    # Each stream waits for the other: warp has made some of the arrays, and frees them on its own.
    stream = wp.stream_from_torch(torch.cuda.current_stream(device.ordinal))
    with wp.ScopedStream(stream, sync_enter=True, sync_exit=True):
        launcher.launch(kernel, count, inputs, outputs, device)
