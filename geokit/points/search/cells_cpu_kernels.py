"""Counting sort of points by cell on a CPU: each thread counts, then places, a share of the points.

A counting sort needs no comparison and no second copy of the keys. With few threads, and not many more cells than
points, it is several times as fast as a comparison sort. Only four bytes a point are scattered; coordinates are then
gathered in sorted order, since scattered reads are faster than scattered writes.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
from typing import Any

import warp as wp

from geokit.core import cpp
from geokit.points.search.cells_kernels import CellGrid

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Points gathered by one item.
GATHERED = wp.constant(1 << 12)


@wp.kernel
@cpp.native_item("points/search/cells_cpu.inl", "count", GATHERED=int(GATHERED))
def count_kernel(first: int, points: wp.array(dtype=Any), grid: CellGrid):
    """Cell of each point of a share, and the number of the share's points in each cell."""


@wp.kernel
@cpp.native_item("points/search/cells_cpu.inl", "place", CellGrid, GATHERED=int(GATHERED))
def place_kernel(first: int):
    """Place the points of a share; ``next_place`` is the next free position of the share in each cell."""


@wp.kernel
@cpp.native_item("points/search/cells_cpu.inl", "gather", GATHERED=int(GATHERED))
def gather_kernel(first: int, points: wp.array(dtype=Any), order: wp.array(dtype=wp.int32), out_grid: CellGrid):
    """Gather the coordinates of GATHERED points in sorted order, one array for each axis."""


# Kernels are resolved here once: resolving them at every launch takes longer than the launch.
ROWS = (wp.vec3d, wp.vec3f)
COUNT_OF = {r: wp.overload(count_kernel, {"points": wp.array(dtype=r)}) for r in ROWS}
GATHER_OF = {r: wp.overload(gather_kernel, {"points": wp.array(dtype=r)}) for r in ROWS}
