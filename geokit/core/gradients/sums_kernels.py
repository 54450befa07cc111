"""Sums of the vectors of each index, additions to gradients, and overloads of their kernels."""

from typing import Any

# mypy: ignore-errors
import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def number_kernel(first: int, index: wp.array(dtype=int), out_keys: wp.array(dtype=int), out_rows: wp.array(dtype=int)):
    """Copy the numbers of rows, and number the rows."""
    i = first + wp.tid()
    out_keys[i] = index[i]
    out_rows[i] = i


@wp.kernel
def sum_rows_kernel(
    first: int,
    rows_count: int,
    keys: wp.array(dtype=int),
    order: wp.array(dtype=int),
    rows: wp.array(dtype=wp.vec3d),
    out_total: wp.array(dtype=wp.vec3d),
):
    """Add the rows of a key one after the other; ``order`` has them by their ascending ``keys``."""
    key = first + wp.tid()
    low = wp.lower_bound(keys, 0, rows_count + 1, key)
    total = wp.vec3d()
    while low < rows_count and keys[low] == key:
        total += rows[order[low]]
        low += 1
    out_total[key] = total


@wp.kernel
def add_kernel(first: int, part: wp.array(dtype=Any), out_total: wp.array(dtype=Any)):
    """Add numbers to others of either precision, in float64."""
    i = first + wp.tid()
    out_total[i] = type(out_total[i])(wp.float64(out_total[i]) + wp.float64(part[i]))


def overloads(kernel: Any, vectors: tuple[str, ...], numbers: tuple[str, ...], **others: Any) -> dict[Any, Any]:
    """Overloads of a kernel by the type of the coordinates; parameters are arrays of vectors, of numbers, or others."""
    return {
        number: wp.overload(
            kernel,
            {name: wp.array(dtype=vector) for name in vectors}
            | {name: wp.array(dtype=number) for name in numbers}
            | others,
        )
        for number, vector in ((wp.float32, wp.vec3f), (wp.float64, wp.vec3d))
    }


# By the types of what is added and of the total.
ADD = {
    (part, total): wp.overload(add_kernel, {"part": wp.array(dtype=part), "out_total": wp.array(dtype=total)})
    for part in (wp.float32, wp.float64)
    for total in (wp.float32, wp.float64)
}
