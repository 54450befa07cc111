"""Radius search on a GPU with one thread for each query, and operations on rows of neighbors for any device."""

# mypy: ignore-errors
from typing import Any

import warp as wp

from geokit.core import cpp
from geokit.points.search.cells_kernels import MASK_BITS, CellGrid, cells_of_all, cells_of_own
from geokit.points.search.neighbors_kernels import (
    Queries,
    cells_around,
    lowest_bit,
    near_count,
    near_mask,
    nearness_of,
    reach_of,
    row_count,
    row_range,
)

# Contracted multiply-adds would round the squared distance once instead of five times.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@cpp.func_native("points/search/sort_rows.inl")
def by_distance():
    """Sort ``count`` entries of both arrays from ``begin`` on by ascending (distance, index), in place."""
    ...


@cpp.func_native("points/search/sort_rows.inl")
def sort_together(): ...


@wp.kernel
def sort_rows_kernel(
    first: int,
    offset: wp.array(dtype=wp.int64),
    out_index: wp.array(dtype=wp.int32),
    out_distance: wp.array(dtype=wp.float64),
):
    """Sort rows by ascending index, with one CUDA warp for each: a row has 32 items."""
    i = first + wp.tid()
    row = i // 32
    begin = wp.int32(offset[row])
    sort_together(begin, wp.int32(offset[row + 1]) - begin, i % 32, out_index, out_distance)


def kernels_of(cells_of: wp.Function) -> tuple[wp.Kernel, wp.Kernel]:
    """The kernels of a search, whose queries have cells that a function tells."""

    @wp.kernel
    def count_kernel(
        first: int,
        queries: Queries,
        grid: CellGrid,
        radius: wp.array(dtype=wp.float64),
        self_count: wp.int32,
        out_count: wp.array(dtype=wp.int32),
    ):
        """Number of neighbors of each query, minus ``self_count``. There is one radius for all, or one for each."""
        k = first + wp.tid()
        cells = cells_of(grid, queries.group, k)
        q = wp.vec3d(queries.x[k], queries.y[k], queries.z[k])
        r = radius[wp.min(queries.index[k], radius.shape[0] - 1)]
        box = cells_around(cells, q, reach_of(r))
        near = nearness_of(cells, q, r)
        found = wp.int32(0)
        for row in range(row_count(box)):
            span = row_range(cells, box, row)
            found += near_count(cells, span[0], span[1], near, q, r * r)
        out_count[queries.index[k]] = found - self_count

    @wp.kernel
    def fill_kernel(
        first: int,
        queries: Queries,
        grid: CellGrid,
        radius: wp.array(dtype=wp.float64),
        own: wp.int32,
        offset: wp.array(dtype=wp.int64),
        out_index: wp.array(dtype=wp.int32),
        out_distance: wp.array(dtype=wp.float64),
    ):
        """Neighbors of each query from its offset on, without the point whose index is the query's plus ``own``."""
        k = first + wp.tid()
        cells = cells_of(grid, queries.group, k)
        i = queries.index[k]
        q = wp.vec3d(queries.x[k], queries.y[k], queries.z[k])
        r = radius[wp.min(i, radius.shape[0] - 1)]
        box = cells_around(cells, q, reach_of(r))
        near = nearness_of(cells, q, r)
        # Flat results have fewer than 2^31 entries, which the caller ensures.
        at = wp.int32(offset[i])
        for row in range(row_count(box)):
            span = row_range(cells, box, row)
            for begin in range(span[0], span[1], MASK_BITS):
                mask = near_mask(cells, begin, span[1], near, q, r * r)
                while mask != wp.uint64(0):
                    j = begin + lowest_bit(mask)
                    mask = mask & (mask - wp.uint64(1))
                    if grid.index[j] != i + own:
                        dx = grid.x[j] - q[0]
                        dy = grid.y[j] - q[1]
                        dz = grid.z[j] - q[2]
                        out_index[at] = grid.index[j]
                        out_distance[at] = wp.sqrt((dx * dx + dy * dy) + dz * dz)
                        at += 1

    return count_kernel, fill_kernel


count_kernel, fill_kernel = kernels_of(cells_of_all)
count_in_groups_kernel, fill_in_groups_kernel = kernels_of(cells_of_own)


@wp.kernel
def arrange_kernel(first: int, rows: wp.array(dtype=Any), order: wp.array(dtype=wp.int32), out_queries: Queries):
    """Queries in processing order."""
    i = first + wp.tid()
    p = rows[order[i]]
    out_queries.index[i] = order[i]
    out_queries.x[i] = wp.float64(p[0])
    out_queries.y[i] = wp.float64(p[1])
    out_queries.z[i] = wp.float64(p[2])


@wp.kernel
def own_flag_kernel(first: int, index: wp.array(dtype=wp.int32), count: wp.int32, out_flag: wp.array(dtype=wp.int32)):
    """1 for each sorted point that is one of the first ``count``, else 0."""
    i = first + wp.tid()
    flag = wp.int32(0)
    if index[i] < count:
        flag = wp.int32(1)
    out_flag[i] = flag


@wp.kernel
def own_query_kernel(
    first: int,
    grid: CellGrid,
    flag: wp.array(dtype=wp.int32),
    place: wp.array(dtype=wp.int32),
    out_queries: Queries,
):
    """The flagged points as queries; ``place`` is the inclusive prefix sum of the flags."""
    i = first + wp.tid()
    if flag[i] == 1:
        at = place[i] - 1
        out_queries.index[at] = grid.index[i]
        out_queries.x[at] = grid.x[i]
        out_queries.y[at] = grid.y[i]
        out_queries.z[at] = grid.z[i]


@wp.kernel
def uncount_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    rows: wp.array(dtype=Any),
    first_point: wp.int32,
    radius: wp.array(dtype=wp.float64),
    out_count: wp.array(dtype=wp.int32),
):
    """Subtract 1 for each query that has its own point among its neighbors."""
    i = first + wp.tid()
    p = points[first_point + i]
    q = rows[i]
    r = radius[wp.min(i, radius.shape[0] - 1)]
    dx = p[0] - wp.float64(q[0])
    dy = p[1] - wp.float64(q[1])
    dz = p[2] - wp.float64(q[2])
    if (dx * dx + dy * dy) + dz * dz <= r * r:
        out_count[i] = out_count[i] - 1


@wp.kernel
def sort_by_distance_kernel(
    first: int,
    offset: wp.array(dtype=wp.int64),
    out_index: wp.array(dtype=wp.int32),
    out_distance: wp.array(dtype=wp.float64),
):
    """Sort each row, given by ascending index, by ascending distance, then index."""
    i = first + wp.tid()
    begin = wp.int32(offset[i])
    by_distance(begin, wp.int32(offset[i + 1]) - begin, out_index, out_distance)


@wp.func
def first_above(offset: wp.array(dtype=wp.int64), index: wp.array(dtype=wp.int32), row: wp.int32, point: wp.int32):
    """Position in an ascending row where the indices above ``point`` begin."""
    return wp.lower_bound(index, wp.int32(offset[row]), wp.int32(offset[row + 1]) + 1, point + 1)


@wp.kernel
def pair_count_kernel(
    first: int,
    offset: wp.array(dtype=wp.int64),
    index: wp.array(dtype=wp.int32),
    out_count: wp.array(dtype=wp.int32),
):
    """Number of neighbors of each point with an index above its own."""
    i = first + wp.tid()
    out_count[i] = wp.int32(offset[i + 1]) - first_above(offset, index, i, i)


@wp.kernel
def pair_fill_kernel(
    first: int,
    offset: wp.array(dtype=wp.int64),
    index: wp.array(dtype=wp.int32),
    distance: wp.array(dtype=wp.float64),
    pair_offset: wp.array(dtype=wp.int64),
    out_pair: wp.array(dtype=wp.int32, ndim=2),
    out_distance: wp.array(dtype=wp.float64),
):
    """Pairs of each point with its neighbors of higher index."""
    i = first + wp.tid()
    begin = first_above(offset, index, i, i)
    at = wp.int32(pair_offset[i])
    for j in range(begin, wp.int32(offset[i + 1])):
        out_pair[at, 0] = i
        out_pair[at, 1] = index[j]
        out_distance[at] = distance[j]
        at += 1


ROWS = (wp.vec3d, wp.vec3f)
ARRANGE = {r: wp.overload(arrange_kernel, {"rows": wp.array(dtype=r)}) for r in ROWS}
UNCOUNT = {r: wp.overload(uncount_kernel, {"rows": wp.array(dtype=r)}) for r in ROWS}
