"""Bounding boxes of shares of the points on a CPU, in one sequential pass with vector loads."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
from typing import Any

import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False})

# Points of a share: 24 KiB, small enough that all threads finish together.
SHARE = wp.constant(1 << 10)


@wp.kernel
@cpp.native_item("points/search/bounding_box_cpu.inl", "box_of", SHARE=int(SHARE))
def survey_host_kernel(first: int, points: wp.array(dtype=Any)):
    """Bounding box of each run of SHARE consecutive points; it is not finite if one of its points is not."""


SURVEY_HOST = {r: wp.overload(survey_host_kernel, {"points": wp.array(dtype=r)}) for r in (wp.vec3d, wp.vec3f)}
