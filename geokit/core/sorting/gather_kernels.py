"""Rows of an array in another order, or some of them."""

from typing import Any

# mypy: ignore-errors
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def gather_kernel(
    first: int,
    rows: wp.array(dtype=Any),
    index: wp.array(dtype=wp.int32),
    out_rows: wp.array(dtype=Any),
):
    i = first + wp.tid()
    out_rows[i] = rows[index[i]]


# By the type of a row.
GATHER = {
    kind: wp.overload(gather_kernel, {"rows": wp.array(dtype=kind), "out_rows": wp.array(dtype=kind)})
    for kind in (wp.vec3d, wp.vec3f, wp.vec3i, wp.int32, wp.int64)
}
