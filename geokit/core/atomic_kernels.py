"""Atomic functions that hold on a CPU too.

Warp's own are plain reads and writes there, where geokit runs a launch in several threads.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False})


def _lower(number: str, atomic: str) -> str:
    # Looked at first: most values are not lower, and threads that only read do not wait for each other.
    return f"""
        {number}* const place = values.data + at;
        {number} seen = *(volatile {number}*)place;
    #if defined(__CUDA_ARCH__)
        if (value < seen) atomicMin(({atomic}*)place, ({atomic})value);
    #else
        while (value < seen &&
               !__atomic_compare_exchange_n(place, &seen, value, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {{
        }}
    #endif
    """


@wp.func_native(_lower("int", "int"))
def lower_to(values: wp.array(dtype=wp.int32), at: wp.int32, value: wp.int32):
    """``values[at] = min(values[at], value)``."""
    ...


@wp.func_native(_lower("int64_t", "long long"))
def lower_to(values: wp.array(dtype=wp.int64), at: wp.int32, value: wp.int64):  # noqa: F811
    """The same of 64-bit integers."""
    ...
