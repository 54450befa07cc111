"""Arrays as kernels of derivatives take and give them: of warp, and of NumPy on a CPU.

:class:`geokit.core.gradients.tensor_rows.TensorArrays` does the same for tensors of torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from geokit.core import launcher
from geokit.core.base.query import Query
from geokit.core.gradients.rules import Asked
from geokit.core.gradients.sums_kernels import ADD, number_kernel, sum_rows_kernel
from geokit.core.interop.arrays import reinterpreted
from geokit.core.memory.host_array import HostArray
from geokit.core.memory.unchecked import sort_pairs

__all__ = ["WarpArrays", "add_to", "pulled_by_kernel"]

_VECTORS = {wp.float32: wp.vec3f, wp.float64: wp.vec3d}
_NUMBERS = {vector: number for number, vector in _VECTORS.items()}


class WarpArrays:
    """What the kernel of a derivative works on: arrays on one device, whose coordinates are of one precision.

    Attributes:
        device: The device of the arrays.
        number: The type of the coordinates, float32 or float64.
    """

    def __init__(self, device: wp.Device, number: Any) -> None:
        self.device, self.number = device, number

    def given(self, values: Any, width: int = 1) -> Any:
        """Values as an argument of a kernel: numbers, or rows of ``width`` 3 as vectors, whatever their leading axes.

        None is an array without rows.
        """
        if values is None:
            return wp.empty(0, dtype=_VECTORS[self.number] if width == 3 else self.number, device=self.device)
        if not isinstance(values, wp.array):
            return HostArray(np.ascontiguousarray(values.reshape(-1, 3) if width == 3 else values.reshape(-1)))
        number = _numbers_of(values)
        count = values.size * (1 if number is values.dtype else 3) // width
        return reinterpreted(values, _VECTORS[number] if width == 3 else number, (count,))

    def made(self, count: int, width: int, number: Any = None) -> Any:
        """A new array of ``count`` numbers or vectors, of the coordinates' type if no other is given."""
        number = number or self.number
        return wp.empty(count, dtype=_VECTORS[number] if width == 3 else number, device=self.device)

    def launch(self, kernel: Any, count: int, inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
        """Run a kernel; outputs are arrays that :meth:`made` gave."""
        launcher.launch(kernel, count, inputs, outputs, self.device)

    def added(self, rows: Any, index: Any, count: int) -> Any:
        """The sums (count,) of the vectors of each index, in the order of the rows: the same bits in every run."""
        total = wp.empty(count, dtype=wp.vec3d, device=self.device)
        # The sort uses the second half of both arrays as scratch memory.
        keys = wp.empty(2 * len(index), dtype=wp.int32, device=self.device)
        order = wp.empty(2 * len(index), dtype=wp.int32, device=self.device)
        if len(index):
            launcher.launch(number_kernel, len(index), [index], [keys, order], self.device)
            sort_pairs(keys, order, len(index))
        launcher.launch(sum_rows_kernel, count, [len(index), keys, order, rows], [total], self.device)
        return total


def pulled_by_kernel(
    query: Query, asked: Asked, answer: Sequence[Any], slopes: Sequence[Any], wanted: list[str]
) -> dict[str, Any] | None:
    """The first derivatives by a query's kernel, for arrays of warp or of NumPy; None where it does not take these."""
    adjoint = query.rule().adjoint
    rows = [asked.tensors[name] for name in query.inputs if name in asked.tensors]
    given = [*rows, *answer, *(slope for slope in slopes if slope is not None)]
    if adjoint is None or not all(map(_is_taken, given)):
        return None
    devices = {str(getattr(array, "device", "cpu")) for array in given}
    numbers = {_numbers_of(array) for array in given} - {wp.int32, wp.int64}
    if len(devices) > 1 or len(numbers) > 1 or not numbers.issubset(_VECTORS):
        return None
    (device,), (number,) = devices, numbers
    found: dict[str, Any] | None = adjoint(asked, answer, slopes, wanted, WarpArrays(wp.get_device(device), number))
    return found


def add_to(total: Any, part: Any) -> None:
    """Add to a contiguous array what :func:`pulled_by_kernel` gave for it."""
    numbers = [_numbers_of(array) for array in (part, total)]
    flat = [reinterpreted(array, number, (array.size * (1 if number is array.dtype else 3),))
            for array, number in zip((part, total), numbers, strict=True)]  # fmt: skip
    launcher.launch(ADD[tuple(numbers)], len(flat[1]), flat[:1], flat[1:], total.device)


def _is_taken(array: Any) -> bool:
    return not isinstance(array, wp.array) or (array.is_contiguous and array.size > 0)


def _numbers_of(array: Any) -> Any:
    """The type of the numbers of an array of numbers or vectors."""
    if not isinstance(array, wp.array):
        return wp.dtype_from_numpy(array.dtype)
    return _NUMBERS.get(array.dtype, array.dtype)
