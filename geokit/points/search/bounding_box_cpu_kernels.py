"""Bounding boxes of shares of the points on a CPU, in one sequential pass with vector loads."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
from typing import Any

import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False})

# Points of a share: 24 KiB, small enough that all threads finish together.
SHARE = wp.constant(1 << 10)


@cpp.func_native("points/search/bounding_box_cpu.inl")
def box_of(
    points: wp.array(dtype=Any),
    begin: wp.int32,
    end: wp.int32,
    share: wp.int32,
    out_lower: wp.array(dtype=wp.vec3d),
    out_upper: wp.array(dtype=wp.vec3d),
): ...


@wp.kernel
def survey_host_kernel(
    first: int,
    points: wp.array(dtype=Any),
    out_lower: wp.array(dtype=wp.vec3d),
    out_upper: wp.array(dtype=wp.vec3d),
):
    """Bounding box of each run of SHARE consecutive points; it is not finite if one of its points is not."""
    i = first + wp.tid()
    begin = i * SHARE
    box_of(points, begin, wp.min(begin + SHARE, points.shape[0]), i, out_lower, out_upper)


SURVEY_HOST = {r: wp.overload(survey_host_kernel, {"points": wp.array(dtype=r)}) for r in (wp.vec3d, wp.vec3f)}
