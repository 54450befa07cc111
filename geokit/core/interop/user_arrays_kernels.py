"""Checks and casts of arrays that already live on a GPU, so that they need not visit the host."""

# mypy: ignore-errors
import warp as wp

from geokit.core.atomic_kernels import lower_to

wp.set_module_options({"enable_backward": False})

# LARGEST_MEASURED of core/interop/user_arrays.
LARGEST = wp.constant(wp.float64(1e150))


@wp.func
def is_within(p: wp.vec3d, largest: wp.float64) -> bool:
    """Whether no coordinate is above ``largest`` in magnitude; False for NaN."""
    return wp.abs(p[0]) <= largest and wp.abs(p[1]) <= largest and wp.abs(p[2]) <= largest


@wp.func
def is_measurable(p: wp.vec3d) -> bool:
    """Whether ``p`` is finite, and squares of its distances stay within float64."""
    return is_within(p, LARGEST)


@wp.kernel
def first_nonfinite_kernel(
    first: int, points: wp.array(dtype=wp.vec3d), largest: wp.float64, out_row: wp.array(dtype=int)
):
    """The lowest row with a NaN, or a coordinate above ``largest``; out_row keeps its start value if there is none."""
    i = first + wp.tid()
    if not is_within(points[i], largest):
        lower_to(out_row, 0, i)


@wp.kernel
def first_short_kernel(
    first: int, vectors: wp.array(dtype=wp.vec3d), shortest: wp.float64, out_row: wp.array(dtype=int)
):
    """The lowest row whose largest component is below ``shortest``; out_row keeps its start value where none is."""
    i = first + wp.tid()
    v = vectors[i]
    if wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2])) < shortest:
        lower_to(out_row, 0, i)


@wp.kernel
def widen_kernel(first: int, values: wp.array(dtype=wp.vec3f), out_values: wp.array(dtype=wp.vec3d)):
    i = first + wp.tid()
    out_values[i] = wp.vec3d(values[i])


@wp.kernel
def narrow_kernel(first: int, values: wp.array(dtype=wp.float64), out_values: wp.array(dtype=wp.float32)):
    i = first + wp.tid()
    out_values[i] = wp.float32(values[i])
