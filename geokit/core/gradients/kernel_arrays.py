"""Arrays of warp as kernels of derivatives take and give them.

:class:`geokit.core.gradients.tensor_rows.TensorArrays` does the same for tensors of torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from geokit.core import launcher
from geokit.core.base.query import Query
from geokit.core.gradients.rules import Asked
from geokit.core.gradients.sums_kernels import ADD, number_kernel, sum_rows_kernel
from geokit.core.interop.arrays import detached, reinterpreted
from geokit.core.memory.unchecked import sort_pairs

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
    """The first derivatives by a query's kernel on its device, for arrays of warp or of NumPy; None where it has none.

    Arrays elsewhere, of several precisions or with gaps are copied.
    """
    adjoint = query.rule().adjoint
    if adjoint is None:
        return None
    owner, rows = asked.arguments.get("self"), [name for name in query.inputs if name in asked.tensors]
    device = launcher.resolve_device(getattr(owner, "_device", None) or asked.arguments.get("device"))
    given = [*(asked.tensors[name] for name in rows), *answer, *slopes]
    kinds = {_numbers_of(array) for array in given if array is not None} - {wp.int32, wp.int64}
    number = wp.float32 if kinds == {wp.float32} else wp.float64
    given = [None if array is None else _there(array, device, number) for array in given]
    asked = asked._replace(tensors={**asked.tensors, **dict(zip(rows, given, strict=False))})
    begin, end = len(rows), len(rows) + len(answer)
    found: dict[str, Any] | None = adjoint(asked, given[begin:end], given[end:], wanted, WarpArrays(device, number))
    return found


def add_to(array: Any, part: Any) -> None:
    """Add to the gradient of an array of warp what was found for it."""
    total = array.grad
    if total is None or not total.size:
        return
    whole = total if total.is_contiguous else detached(total)
    pair = [_there(part, total.device, _numbers_of(part)), whole]
    numbers = [_numbers_of(one) for one in pair]
    flat = [reinterpreted(one, number, (one.size * (1 if number is one.dtype else 3),))
            for one, number in zip(pair, numbers, strict=True)]  # fmt: skip
    launcher.launch(ADD[tuple(numbers)], len(flat[1]), flat[:1], flat[1:], total.device)
    if whole is not total:
        wp.copy(total, whole)


def _there(array: Any, device: wp.Device, number: Any) -> Any:
    """An array of warp without gaps on a device, floats of a precision."""
    if isinstance(array, wp.array):
        if array.device == device and _numbers_of(array) in (number, wp.int32, wp.int64):
            return array if array.is_contiguous else detached(array)
        array = array.numpy()
    kind = number if array.dtype.kind == "f" else wp.dtype_from_numpy(array.dtype)
    return wp.array(array, dtype=kind, device=device)


def _numbers_of(array: Any) -> Any:
    """The type of the numbers of an array of numbers or vectors."""
    if not isinstance(array, wp.array):
        return wp.dtype_from_numpy(array.dtype)
    return _NUMBERS.get(array.dtype, array.dtype)
