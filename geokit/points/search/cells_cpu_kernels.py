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


@cpp.func_native("points/search/cells_cpu.inl")
def count(
    points: wp.array(dtype=Any),
    grid: CellGrid,
    share: wp.int32,
    begin: wp.int32,
    end: wp.int32,
    cell_count: wp.int32,
    out_key: wp.array(dtype=wp.int32),
    out_counts: wp.array(dtype=wp.int32),
): ...


@cpp.func_native("points/search/cells_cpu.inl")
def place(
    key: wp.array(dtype=wp.int32),
    share: wp.int32,
    begin: wp.int32,
    end: wp.int32,
    cell_count: wp.int32,
    next_place: wp.array(dtype=wp.int32),
    grid: CellGrid,
): ...


@cpp.func_native("points/search/cells_cpu.inl")
def gather(
    points: wp.array(dtype=Any),
    order: wp.array(dtype=wp.int32),
    begin: wp.int32,
    end: wp.int32,
    grid: CellGrid,
): ...


@wp.kernel
def count_kernel(
    first: int,
    points: wp.array(dtype=Any),
    grid: CellGrid,
    share: wp.int32,
    cell_count: wp.int32,
    out_key: wp.array(dtype=wp.int32),
    out_counts: wp.array(dtype=wp.int32),
):
    """Cell of each point of a share, and the number of the share's points in each cell."""
    i = first + wp.tid()
    count(points, grid, i, i * share, wp.min((i + 1) * share, points.shape[0]), cell_count, out_key, out_counts)


@wp.kernel
def place_kernel(
    first: int,
    key: wp.array(dtype=wp.int32),
    share: wp.int32,
    cell_count: wp.int32,
    next_place: wp.array(dtype=wp.int32),
    out_grid: CellGrid,
):
    """Place the points of a share; ``next_place`` is the next free position of the share in each cell."""
    i = first + wp.tid()
    place(key, i, i * share, wp.min((i + 1) * share, key.shape[0]), cell_count, next_place, out_grid)


@wp.kernel
def gather_kernel(first: int, points: wp.array(dtype=Any), order: wp.array(dtype=wp.int32), out_grid: CellGrid):
    """Gather the coordinates of GATHERED points in sorted order, one array for each axis."""
    begin = (first + wp.tid()) * GATHERED
    gather(points, order, begin, wp.min(begin + GATHERED, points.shape[0]), out_grid)


# Kernels are resolved here once: resolving them at every launch takes longer than the launch.
ROWS = (wp.vec3d, wp.vec3f)
COUNT_OF = {r: wp.overload(count_kernel, {"points": wp.array(dtype=r)}) for r in ROWS}
GATHER_OF = {r: wp.overload(gather_kernel, {"points": wp.array(dtype=r)}) for r in ROWS}
