"""Points sorted by the cells of a grid: the arrays read by neighbor searches, and the kernels that fill them.

Coordinates are float64; on a GPU a float32 copy serves as a first test.
"""

# mypy: ignore-errors
from typing import Any

import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Points tested by one call of within_mask: one bit of a 64-bit mask each. The coordinates are padded by as many
# entries, because vectors are read past the end of the last row.
MASK_BITS = wp.constant(64)

# Table entries summed by one item of crowding_kernel.
CROWDING_RUN = wp.constant(64)


@wp.struct
class GroupCells:
    """What a group has for itself: the box of its points, its cells, the first of their keys, and a float32 frame."""

    lower: wp.vec3d
    upper: wp.vec3d
    center: wp.vec3d
    scale: wp.float64
    base: wp.int64
    first_cut: wp.vec3i
    last_cut: wp.vec3i
    count_x: wp.int32
    count_y: wp.int32


@wp.struct
class CellGrid:
    """Points sorted by cell, and the beginning of each cell.

    Each axis is cut into intervals of equal cells. ``cut[i]`` holds the begin of an interval, the inverse edge of its
    cells, its first cell and its number of cells; ``first_cut`` and ``last_cut`` delimit the intervals of each axis.

    The key of a point is ``base + (z * count_y + y) * count_x + x`` of its cell, below ``key_count``. ``start[b]`` is
    the first sorted point whose key is at least ``b << shift``; a finer boundary is found by a search between two
    entries.

    Points in groups have cells for each group, one group after the other: the fields in ``groups`` take the place of
    those here. ``group`` is the group of each point. Groups are packed, so it is the same for sorted points.

    On a GPU ``packed`` holds ``(coordinate - center) * scale`` in float32, 16 bytes a point, read by one load.
    """

    x: wp.array(dtype=wp.float64)
    y: wp.array(dtype=wp.float64)
    z: wp.array(dtype=wp.float64)
    packed: wp.array(dtype=wp.vec4f)
    index: wp.array(dtype=wp.int32)
    key: wp.array(dtype=wp.int64)
    start: wp.array(dtype=wp.int32)
    cut: wp.array(dtype=wp.vec4d)
    first_cut: wp.vec3i
    last_cut: wp.vec3i
    lower: wp.vec3d
    upper: wp.vec3d
    center: wp.vec3d
    scale: wp.float64
    count_x: wp.int32
    count_y: wp.int32
    count_z: wp.int32
    shift: wp.int32
    base: wp.int64
    key_count: wp.int64
    groups: wp.array(dtype=GroupCells)
    group: wp.array(dtype=wp.int32)


@wp.func
def cells_of_group(grid: CellGrid, group: wp.int32) -> CellGrid:
    """The grid of one group; on a CPU see cell_along.inl."""
    own = grid
    cells = grid.groups[group]
    own.lower = cells.lower
    own.upper = cells.upper
    own.center = cells.center
    own.scale = cells.scale
    own.base = cells.base
    own.first_cut = cells.first_cut
    own.last_cut = cells.last_cut
    own.count_x = cells.count_x
    own.count_y = cells.count_y
    return own


@cpp.func_native("points/search/cell_along.inl")
def cell_along(cells: CellGrid) -> wp.int32: ...


@wp.func
def cell_key(grid: CellGrid, x: wp.int32, y: wp.int32, z: wp.int32) -> wp.int64:
    return grid.base + (wp.int64(z) * wp.int64(grid.count_y) + wp.int64(y)) * wp.int64(grid.count_x) + wp.int64(x)


@wp.func
def key_of(grid: CellGrid, p: wp.vec3d) -> wp.int64:
    return cell_key(grid, cell_along(grid, 0, p[0]), cell_along(grid, 1, p[1]), cell_along(grid, 2, p[2]))


@wp.func
def in_double(p: Any) -> wp.vec3d:
    return wp.vec3d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2]))


@wp.kernel
def survey_kernel(
    first: int,
    points: wp.array(dtype=Any),
    run_count: wp.int32,
    out_lower: wp.array(dtype=wp.vec3d),
    out_upper: wp.array(dtype=wp.vec3d),
):
    """Bounding boxes of ``run_count`` shares of the points on a GPU; for a CPU see cells_cpu_kernels.

    The points of a share are ``run_count`` apart, so that adjacent threads read adjacent points. A box is not finite if
    one of its points is not.
    """
    i = first + wp.tid()
    lower = in_double(points[i])
    upper = lower
    # A sum keeps non-finite values; min and max may skip them.
    total = lower - lower
    for at in range(i, points.shape[0], run_count):
        p = in_double(points[at])
        lower = wp.min(lower, p)
        upper = wp.max(upper, p)
        total += p - p
    out_lower[i] = lower + total
    out_upper[i] = upper + total


@wp.kernel
def condense_kernel(
    first: int,
    points: wp.array(dtype=Any),
    lower: wp.array(dtype=wp.vec3d),
    upper: wp.array(dtype=wp.vec3d),
    run_count: wp.int32,
    sample_count: wp.int32,
    out_survey: wp.array(dtype=wp.float64, ndim=2),
):
    """x, y and z of ``run_count`` lower corners, of as many upper corners, and of a sample of the points.

    Each corner is that of all boxes whose numbers differ by multiples of ``run_count``.
    """
    i = first + wp.tid()
    if i < run_count:
        low = lower[i]
        high = upper[i]
        total = low - low
        for j in range(i, lower.shape[0], run_count):
            low = wp.min(low, lower[j])
            high = wp.max(high, upper[j])
            total += lower[j] - lower[j]
        for axis in range(3):
            out_survey[axis, i] = low[axis] + total[axis]
            out_survey[axis, run_count + i] = high[axis] + total[axis]
    if i < sample_count:
        taken = points[wp.int32(wp.int64(i) * wp.int64(points.shape[0]) // wp.int64(sample_count))]
        for axis in range(3):
            out_survey[axis, 2 * run_count + i] = wp.float64(taken[axis])


@wp.kernel
def group_box_kernel(
    first: int,
    points: wp.array(dtype=Any),
    offset: wp.array(dtype=wp.int64),
    most: wp.int64,
    out_lower: wp.array(dtype=wp.vec3d),
    out_upper: wp.array(dtype=wp.vec3d),
):
    """Bounding box of each group of up to ``most`` points; infinite and inside out for others and without points."""
    i = first + wp.tid()
    high = wp.vec3d(wp.float64(wp.inf), wp.float64(wp.inf), wp.float64(wp.inf))
    lower = high
    upper = -high
    if offset[i + 1] - offset[i] <= most:
        for j in range(wp.int32(offset[i]), wp.int32(offset[i + 1])):
            p = in_double(points[j])
            lower = wp.min(lower, p)
            upper = wp.max(upper, p)
    out_lower[i] = lower
    out_upper[i] = upper


@wp.func
def cells_of_all(grid: CellGrid, group: wp.array(dtype=wp.int32), i: wp.int32) -> CellGrid:
    """The cells of a point where there are no groups."""
    return grid


@wp.func
def cells_of_own(grid: CellGrid, group: wp.array(dtype=wp.int32), i: wp.int32) -> CellGrid:
    """The cells of the group of a point."""
    return cells_of_group(grid, group[i])


def kernels_of(cells_of: wp.Function) -> tuple[Any, Any]:
    """The kernels of keys and, on a GPU, of the order of points, whose cells a function tells."""

    @wp.kernel
    def key_kernel(
        first: int,
        points: wp.array(dtype=Any),
        group: wp.array(dtype=wp.int32),
        grid: CellGrid,
        out_key: wp.array(dtype=Any),
        out_index: wp.array(dtype=wp.int32),
    ):
        """Cell key of each point."""
        i = first + wp.tid()
        out_key[i] = out_key.dtype(key_of(cells_of(grid, group, i), in_double(points[i])))
        out_index[i] = i

    @wp.kernel
    def gather_kernel(first: int, points: wp.array(dtype=Any), order: wp.array(dtype=wp.int32), out_grid: CellGrid):
        """Gather the coordinates in sorted order, also in float32 in the frame of their cells."""
        i = first + wp.tid()
        p = in_double(points[order[i]])
        out_grid.index[i] = order[i]
        out_grid.x[i] = p[0]
        out_grid.y[i] = p[1]
        out_grid.z[i] = p[2]
        cells = cells_of(out_grid, out_grid.group, i)
        local = (p - cells.center) * cells.scale
        out_grid.packed[i] = wp.vec4f(wp.float32(local[0]), wp.float32(local[1]), wp.float32(local[2]), wp.float32(0.0))

    return key_kernel, gather_kernel


@wp.kernel
def table_kernel(
    first: int,
    key: wp.array(dtype=Any),
    count: wp.int32,
    shift: wp.int32,
    run: wp.int32,
    out_start: wp.array(dtype=wp.int32),
):
    """Fill ``run`` table entries: the first sorted point whose key is at least ``entry << shift``.

    Each search starts at the end of the previous one, with growing steps, since most cells have few points.
    """
    entry = (first + wp.tid()) * run
    # All keys below `at` are smaller than the bound.
    at = wp.int32(0)
    step = count
    for b in range(entry, wp.min(entry + run, out_start.shape[0])):
        bound = wp.int64(b) << wp.int64(shift)
        end = count
        while at < count and wp.int64(key[at]) < bound and at < end:
            probe = wp.min(at + step, count) - 1
            if probe > at and wp.int64(key[probe]) < bound:
                at = probe
                step = 2 * step
            else:
                # The result lies above `at` and not above `probe`.
                low = at + 1
                end = wp.max(probe, low)
                while low < end:
                    middle = low + (end - low) // 2
                    if wp.int64(key[middle]) < bound:
                        low = middle + 1
                    else:
                        end = middle
                at = low
        out_start[b] = at
        step = wp.int32(8)


@wp.kernel
def crowding_kernel(first: int, start: wp.array(dtype=wp.int32), out_crowding: wp.array(dtype=wp.int64)):
    """Sum of the squared point counts over a run of CROWDING_RUN table entries."""
    run = first + wp.tid()
    total = wp.int64(0)
    for b in range(run * CROWDING_RUN, wp.min((run + 1) * CROWDING_RUN, start.shape[0] - 1)):
        points = wp.int64(start[b + 1] - start[b])
        total += points * points
    out_crowding[run] = total


@wp.kernel
def unsort_kernel(first: int, grid: CellGrid, out_points: wp.array(dtype=wp.vec3d)):
    """The points in their original order."""
    i = first + wp.tid()
    out_points[grid.index[i]] = wp.vec3d(grid.x[i], grid.y[i], grid.z[i])


# Rows are float64, on a GPU also float32; the width of keys follows from the number of cells. Kernels are resolved here
# once: resolving them at every launch takes longer than the launch.
ROWS = (wp.vec3d, wp.vec3f)
SURVEY = {r: wp.overload(survey_kernel, {"points": wp.array(dtype=r)}) for r in ROWS}
CONDENSE = {r: wp.overload(condense_kernel, {"points": wp.array(dtype=r)}) for r in ROWS}
GROUP_BOX = {r: wp.overload(group_box_kernel, {"points": wp.array(dtype=r)}) for r in ROWS}
key_kernel, gather_packed_kernel = kernels_of(cells_of_all)
group_key_kernel, gather_groups_kernel = kernels_of(cells_of_own)
KEY, GROUP_KEY = (
    {
        (r, k): wp.overload(kernel, {"points": wp.array(dtype=r), "out_key": wp.array(dtype=k)})
        for r in ROWS
        for k in (wp.int32, wp.int64)
    }
    for kernel in (key_kernel, group_key_kernel)
)
GATHER_PACKED, GATHER_GROUPS = (
    {r: wp.overload(kernel, {"points": wp.array(dtype=r)}) for r in ROWS}
    for kernel in (gather_packed_kernel, gather_groups_kernel)
)
TABLE = {k: wp.overload(table_kernel, {"key": wp.array(dtype=k)}) for k in (wp.int32, wp.int64)}
