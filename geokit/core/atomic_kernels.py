"""Atomic functions that hold on a CPU too.

Warp's own are plain reads and writes there, where geokit runs a launch in several threads.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.cpp import cpp

wp.set_module_options({"enable_backward": False})


@wp.func_native(cpp("core/lower_to.inl", defines={"NUMBER": "int", "ATOMIC": "int"}))
def lower_to(values: wp.array(dtype=wp.int32), at: wp.int32, value: wp.int32):
    """``values[at] = min(values[at], value)``."""
    ...


@wp.func_native(cpp("core/lower_to.inl", defines={"NUMBER": "int64_t", "ATOMIC": "long long"}))
def lower_to(values: wp.array(dtype=wp.int64), at: wp.int32, value: wp.int64):  # noqa: F811
    """The same of 64-bit integers."""
    ...
