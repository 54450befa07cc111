"""Writes active values into a grid on a device."""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core.atomic_kernels import lower_to

wp.set_module_options({"enable_backward": False})

REALS = (wp.float32, wp.float64)


@wp.kernel
def write_values_kernel(
    first: int, place: wp.array(dtype=wp.int64), value: wp.array(dtype=Any), out_buffer: wp.array(dtype=Any)
):
    i = first + wp.tid()
    out_buffer[place[i]] = type(out_buffer[place[i]])(value[i])


@wp.kernel
def first_bad_kernel(first: int, value: wp.array(dtype=Any), out_row: wp.array(dtype=int)):
    """The lowest row that is not finite; out_row keeps its start value where all are finite."""
    i = first + wp.tid()
    if not wp.isfinite(value[i]):
        lower_to(out_row, 0, i)


WRITE_VALUES = {
    (value, kind): wp.overload(
        write_values_kernel, {"value": wp.array(dtype=value), "out_buffer": wp.array(dtype=kind)}
    )
    for value in REALS
    for kind in REALS
}
FIRST_BAD = {value: wp.overload(first_bad_kernel, {"value": wp.array(dtype=value)}) for value in REALS}
