"""Bounding boxes and counting sort of points by cell on a CPU: each thread counts, then places, a share of the points.

A counting sort needs no comparison and no second copy of the keys. With few threads, and not many more cells than
points, it is several times as fast as a comparison sort. Only four bytes a point are scattered; coordinates are then
gathered in sorted order, since scattered reads are faster than scattered writes.
"""

# mypy: ignore-errors
from typing import Any

import warp as wp

from geokit.core import cpp
from geokit.points.search.cells_kernels import CellGrid

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Points of a share: 24 KiB, small enough that all threads finish together.
SHARE = wp.constant(1 << 10)
# Points gathered by one item.
GATHERED = wp.constant(1 << 12)

NUMBERS = {"SHARE": int(SHARE), "GATHERED": int(GATHERED)}


@wp.kernel
@cpp.native_item("points/search/cells_cpu.inl", "box_of", **NUMBERS)
def survey_host_kernel(first: int, points: wp.array(dtype=Any)):
    """Bounding box of each run of SHARE consecutive points; it is not finite if one of its points is not."""


@wp.kernel
@cpp.native_item("points/search/cells_cpu.inl", "count", **NUMBERS)
def count_kernel(first: int, points: wp.array(dtype=Any), grid: CellGrid):
    """Cell of each point of a share, and the number of the share's points in each cell."""


@wp.kernel
@cpp.native_item("points/search/cells_cpu.inl", "place", **NUMBERS)
def place_kernel(first: int, grid: CellGrid):
    """Place the points of a share; ``next_place`` is the next free position of the share in each cell."""


@wp.kernel
@cpp.native_item("points/search/cells_cpu.inl", "gather", **NUMBERS)
def gather_kernel(first: int, points: wp.array(dtype=Any), grid: CellGrid):
    """Gather the coordinates of GATHERED points in sorted order, one array for each axis."""


# Kernels are resolved here once: resolving them at every launch takes longer than the launch.
ROWS = (wp.vec3d, wp.vec3f)
SURVEY_HOST = {r: wp.overload(survey_host_kernel, {"points": wp.array(dtype=r)}) for r in ROWS}
COUNT_OF = {r: wp.overload(count_kernel, {"points": wp.array(dtype=r)}) for r in ROWS}
GATHER_OF = {r: wp.overload(gather_kernel, {"points": wp.array(dtype=r)}) for r in ROWS}
