"""Points sorted by cell: the data structure of every radius search. Its memory depends only on the number of points."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory import host_pool
from geokit.core.memory.unchecked import sort_pairs
from geokit.errors import InputError

# Each axis is cut into this many intervals with about equally many points. An interval too long for cells of the radius
# gets longer cells of its own; the others keep theirs. Otherwise one far point, or clusters far apart, could leave a
# crowd in a single cell.
INTERVALS = 64
# Three axes of 64 intervals of 2^14 cells each: keys fit in 63 bits.
MAX_CELLS_PER_INTERVAL = 1 << 14
# More cells in an interval than points in it separate nothing; small sets of points still get this many.
MIN_CELLS_PER_INTERVAL = 16
# Size of the sample of coordinates that places the intervals: 32 for each interval, so that an interval holds at most
# about half more or fewer points than intended.
SAMPLE_SIZE = 2048
# The inverse of a cell's edge must stay finite, and so must its product with a coordinate. Cells longer than the radius
# cost time, but never lose neighbors.
MAX_INVERSE_EDGE = 1e300
# Bound on the table for any extent: this many entries for each point, plus the second number; 16 bytes a point plus 256
# KiB. With four entries a point, most tables of evenly spread points are direct.
TABLE_ENTRIES_PER_POINT = 4
TABLE_ENTRIES_MORE = 1 << 16
# Table entries of an item: on a CPU one search through all keys serves many entries, on a GPU many items are needed.
TABLE_RUN_HOST = 64
TABLE_RUN_GPU = 8
TABLE_GRAIN = 16
# The points are surveyed in shares. On a CPU a slice has at least this many, which one thread reads in the time that
# waking another takes; on a GPU each of this many threads has one.
SURVEY_GRAIN = 512
SURVEY_THREADS = 1 << 16
# The boxes of the shares are reduced to this many before they are copied to the host.
CONDENSED = 1024
# Acceptable number of cells for each point, and by how much edges may exceed the radius to stay within it.
FEW_CELLS = 2.0
MOST_STRETCH = 1.5
# Counting by cell needs a row of counts for each thread: at most this many numbers a point, plus TABLE_ENTRIES_MORE.
COUNTS_PER_POINT = 8
# Points that are worth another thread: one thread sorts fewer points in the time that waking threads and sharing cache
# lines between them takes.
COUNTED_SHARE = 1 << 18
# Range of exponents of float64: the scale of the float32 frame stays within it.
LARGEST_EXPONENT = 1000


@dataclass(frozen=True, eq=False)
class Cells:
    """Sorted points on a device.

    Attributes:
        grid: The CellGrid that kernels read.
        radius: The search radius [world] that the cells are made for.
    """

    grid: Any
    radius: float


@dataclass(frozen=True, eq=False)
class Survey:
    """Bounding box and sample of the points, taken before they are sorted.

    Attributes:
        lower: Lower corner of the bounding box [world], zeros if there are no points.
        upper: Upper corner of the bounding box [world].
        sample: Some of the points, evenly spaced in their order; shape (3, S) [world].
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    sample: NDArray[np.float64]

    # Cached, because a GPU waits while these are computed on the host.
    @functools.cached_property
    def crowd(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner of a box around all but the outermost points of each axis [world]."""
        count = self.sample.shape[1]
        if count == 0:
            return np.zeros(3), np.zeros(3)
        outermost = count // INTERVALS
        return self.ascending[:, outermost], self.ascending[:, -1 - outermost]

    @functools.cached_property
    def ascending(self) -> NDArray[np.float64]:
        """The sample with each axis sorted separately."""
        return np.sort(self.sample, axis=1)


def survey(points: "wp.array", refuse: Callable[[], Any] | None = None) -> Survey:
    """Bounding box and sample of vec3d or vec3f points [world], in one pass over them.

    Args:
        points: The points.
        refuse: Called if a point is not finite, to raise the error that names it; None where all are known to be.
    Raises:
        InputError: The extent of the points overflows float64.
    """
    from geokit.points.search import cells_kernels as kernels
    from geokit.points.search.cells_cpu_kernels import SHARE, SURVEY_HOST

    device: Any = points.device
    count = len(points)
    if count == 0:
        return Survey(np.zeros(3), np.zeros(3), np.zeros((3, 0)))
    runs = -(-count // int(SHARE)) if device.is_cpu else min(count, SURVEY_THREADS)
    boxes = [wp.empty(runs, dtype=wp.vec3d, device=device) for _ in range(2)]
    if device.is_cpu:
        launcher.launch(SURVEY_HOST[points.dtype], runs, [points], boxes, device, grain=SURVEY_GRAIN)
    else:
        launcher.launch(kernels.SURVEY[points.dtype], runs, [points, runs], boxes, device)
    few, taken = min(runs, CONDENSED), min(count, SAMPLE_SIZE)
    out = wp.empty((3, 2 * few + taken), dtype=wp.float64, device=device)
    given = [points, *boxes, few, taken]
    # Shorter than the time that waking a thread takes.
    launcher.launch(kernels.CONDENSE[points.dtype], max(few, taken), given, [out], device, grain=SAMPLE_SIZE)
    found = out.numpy()
    if refuse is not None and not np.isfinite(found).all():
        refuse()
    lower, upper = found[:, :few].min(axis=1), found[:, few : 2 * few].max(axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        if not np.isfinite(upper - lower).all():
            raise InputError(
                f"points: they spread from {lower.tolist()} to {upper.tolist()}, more than a float64 can hold; "
                "scale them down"
            )
    return Survey(lower, upper, found[:, 2 * few :])


def usual_spacing(survey: Survey, count: int) -> float:
    """Mean spacing [world]: edge of the cubes, squares or segments that would hold one point of the crowd each."""
    lower, upper = survey.crowd
    edges = (upper - lower)[upper > lower]
    if not count or not len(edges):
        return 0.0
    # In logarithms, because a product of three extents may overflow.
    return float(np.exp((np.log(edges).sum() - np.log(count)) / len(edges)))


def build_cells(points: "wp.array", survey: Survey, radius: float) -> Cells:
    """Sort points into cells of about the radius.

    Args:
        points: vec3d or vec3f positions (N,) [world]; copied.
        survey: Bounding box and sample of the points.
        radius: Edge length of a cell [world] if the extent allows it; above 0.
    Returns:
        Cells. Memory: 28 bytes a point (44 on a GPU), 8 more if the table is not direct, and up to 16 for the table; up
        to 28 more during construction.
    """
    from geokit.points.search import cells_kernels as kernels

    device: Any = points.device
    count = len(points)
    grid: Any = kernels.CellGrid()
    grid.lower, grid.upper = wp.vec3d(*survey.lower.tolist()), wp.vec3d(*survey.upper.tolist())
    center, scale = frame(survey)
    grid.center, grid.scale = wp.vec3d(*center.tolist()), wp.float64(scale)
    cell_count = _cut_axes(grid, survey, count, _edge(survey, count, radius), device)
    return Cells(grid=place(grid, points, cell_count), radius=radius)


def place(grid: Any, points: "wp.array", cell_count: int) -> Any:
    """Sort the points into the cells of the grid, which it returns."""
    device: Any = points.device
    count = len(points)
    grid.key_count = cell_count
    grid.shift = _table_shift(cell_count, count)
    _make_room(grid, count, device)
    # Positions in the counts are int32, and the counts should not be much larger than the points.
    most = min(COUNTS_PER_POINT * count + TABLE_ENTRIES_MORE, 2**31 - 1) // max(cell_count, 1)
    rows = min(launcher.thread_count(), -(-count // COUNTED_SHARE), most)
    if device.is_cpu and grid.shift == 0 and rows:
        _place_by_count(grid, points, cell_count, rows)
    else:
        _place_by_sort(grid, points, cell_count)
    return grid


def has_groups(grid: Any) -> bool:
    """Whether each group of points has cells of its own (:mod:`geokit.points.search.groups`)."""
    return grid.groups is not None and len(grid.groups) > 0


def _edge(survey: Survey, count: int, radius: float) -> float:
    """The radius, or a slightly longer edge if that leaves at most FEW_CELLS cells for each point.

    Cells longer by a fifth need a fifth more tests but a fifth fewer lookups of ranges; empty cells cost time to build.
    """
    share = 1.0 / max(FEW_CELLS * count, 1.0)
    for extent in (survey.upper - survey.lower).tolist():
        share *= max(extent / radius, 1.0)
    return radius * share ** (1.0 / 3.0) if 1.0 < share <= MOST_STRETCH**3 else radius


def frame(survey: Survey) -> tuple[NDArray[np.float64], float]:
    """The float32 frame: the middle of the crowd, and a power of two as scale, so that scaling is exact."""
    lower, upper = survey.crowd
    center = lower + 0.5 * (upper - lower)
    extent = float((upper - lower).max(initial=0.0))
    exponent = -np.frexp(extent)[1] if extent > 0.0 else 0
    return center, float(np.ldexp(1.0, int(np.clip(exponent, -LARGEST_EXPONENT, LARGEST_EXPONENT))))


def _make_room(grid: Any, count: int, device: Any) -> None:
    from geokit.points.search import cells_kernels as kernels

    if device.is_cuda:
        grid.x, grid.y, grid.z = (wp.empty(count, dtype=wp.float64, device=device) for _ in range(3))
        grid.packed = wp.empty(count, dtype=wp.vec4f, device=device)
        return
    # Vectors are read past the end of the last row; the excess lanes are masked out.
    padded = count + int(kernels.MASK_BITS)
    grid.x, grid.y, grid.z = (_padded(count, padded, wp.float64, device) for _ in range(3))


def _padded(count: int, padded: int, dtype: Any, device: Any) -> "wp.array":
    """Room for ``padded`` entries of which those from ``count`` on are 0."""
    array = host_pool.empty_warp(padded, dtype, device)
    array[count:].zero_()
    return array


def _place_by_count(grid: Any, points: "wp.array", cell_count: int, rows: int) -> None:
    """Counting sort on a CPU with a direct table: each thread counts its share of the points, then places it."""
    from geokit.core.sorting.counting_sort_cpu_kernels import sum_kernel
    from geokit.points.search import cells_cpu_kernels as kernels

    device: Any = points.device
    count = len(points)
    share = -(-count // rows)
    keys = host_pool.empty_warp(count, wp.int32, device)
    counts = wp.zeros(rows * cell_count, dtype=wp.int32, device=device)
    given = [points, grid, share, cell_count]
    launcher.launch(kernels.COUNT_OF[points.dtype], rows, given, [keys, counts], device, grain=1)
    grid.start = wp.empty(cell_count + 2, dtype=wp.int32, device=device)
    launcher.launch(sum_kernel, 1, [rows, cell_count], [counts, grid.start], device)
    grid.key = wp.empty(0, dtype=wp.int64, device=device)
    grid.index = host_pool.empty_warp(count, wp.int32, device)
    launcher.launch(kernels.place_kernel, rows, [keys, share, cell_count, counts], [grid], device, grain=1)
    _gather(grid, points, grid.index)


def _gather(grid: Any, points: "wp.array", order: "wp.array") -> None:
    """Gather the coordinates in sorted order, on a CPU."""
    from geokit.points.search.cells_cpu_kernels import GATHER_OF, GATHERED

    items = -(-len(points) // int(GATHERED))
    # All items take equally long.
    grain = max(COUNTED_SHARE // int(GATHERED), -(-items // (2 * launcher.thread_count())))
    launcher.launch(GATHER_OF[points.dtype], items, [points, order], [grid], points.device, grain=grain)


def _place_by_sort(grid: Any, points: "wp.array", cell_count: int) -> None:
    from geokit.points.search import cells_kernels as kernels

    device: Any = points.device
    count = len(points)
    keys, order = sorted_keys(grid, points, grid.group if has_groups(grid) else None)
    grid.index = host_pool.empty_warp(count, wp.int32, device)
    if device.is_cpu:
        wp.copy(grid.index, order, count=count)
        _gather(grid, points, order)
    else:
        gather = kernels.GATHER_GROUPS if has_groups(grid) else kernels.GATHER_PACKED
        launcher.launch(gather[points.dtype], count, [points, order], [grid], device)
    grid.start = wp.empty((cell_count >> grid.shift) + 2, dtype=wp.int32, device=device)
    run = TABLE_RUN_HOST if device.is_cpu else TABLE_RUN_GPU
    given = [keys, count, grid.shift, run]
    launcher.launch(
        kernels.TABLE[keys.dtype], -(-len(grid.start) // run), given, [grid.start], device, grain=TABLE_GRAIN
    )
    # A direct table needs no key again.
    grid.key = _head(keys, count) if grid.shift else wp.empty(0, dtype=wp.int64, device=device)


def sorted_keys(grid: Any, points: "wp.array", group: Any) -> tuple["wp.array", "wp.array"]:
    """Keys of the points in ascending order and the indices of these points, in the first half of each array.

    ``group`` is the group of each point; None if there are none.
    """
    from geokit.points.search import cells_kernels as kernels

    device: Any = points.device
    count = len(points)
    # radix_sort_pairs uses the second half of both arrays as scratch space. Keys of a table that is not direct are
    # searched later, in 64 bits.
    cell_count = int(grid.key_count)
    wide = grid.shift > 0 or cell_count >= 1 << 31
    keys = wp.empty(2 * count, dtype=wp.int64 if wide else wp.int32, device=device)
    order = wp.empty(2 * count, dtype=wp.int32, device=device)
    table, group = (kernels.KEY, grid.group) if group is None else (kernels.GROUP_KEY, group)
    launcher.launch(table[points.dtype, keys.dtype], count, [points, group, grid], [keys, order], device)
    if count:
        sort_pairs(keys, order, count, end_bit=max(1, (cell_count - 1).bit_length()))
    return keys, order


def _cut_axes(grid: Any, survey: Survey, count: int, radius: float, device: Any) -> int:
    """Cut the three axes into cells for the grid; returns the total number of cells."""
    most = min(max(count // INTERVALS, MIN_CELLS_PER_INTERVAL), MAX_CELLS_PER_INTERVAL)
    cuts, sizes, first = [], [], 0
    for axis in range(3):
        cut = intervals(survey, axis, radius, most)
        grid.first_cut[axis], grid.last_cut[axis] = first, first + len(cut) - 1
        first += len(cut)
        cuts.append(cut)
        sizes.append(int(cut[:, 3].sum()))
    grid.cut = wp.array(np.concatenate(cuts), dtype=wp.vec4d, device=device)
    grid.count_x, grid.count_y, grid.count_z = sizes
    return sizes[0] * sizes[1] * sizes[2]


def intervals(survey: Survey, axis: int, radius: float, most: int) -> NDArray[np.float64]:
    """Begin, inverse cell edge, first cell and number of cells of the intervals of an axis; shape (I, 4).

    An interval between quantiles that needs more than ``most`` cells of the radius gets ``most`` cells. Neighboring
    intervals that need no cut become one.
    """
    lower, upper = float(survey.lower[axis]), float(survey.upper[axis])
    if upper - lower <= radius * most:
        # No interval can be longer. An axis without extent has one cell, to which the clamp maps every coordinate.
        count = max((upper - lower) // radius, 1.0)
        return np.array([[lower, min(count / (upper - lower), MAX_INVERSE_EDGE) if upper > lower else 1.0, 0.0, count]])
    ascending = survey.ascending[axis]
    inner = ascending[np.arange(1, INTERVALS) * len(ascending) // INTERVALS]
    knots = np.unique(np.concatenate([[lower, upper], inner]))
    is_long = np.diff(knots) > radius * most
    begins = np.concatenate([[True], is_long[1:] | is_long[:-1]])
    width = np.diff(np.append(knots[:-1][begins], upper))
    with np.errstate(over="ignore"):
        counts = np.where(is_long[begins], most, np.maximum(np.floor(width / radius), 1.0))
        inverse = np.minimum(counts / width, MAX_INVERSE_EDGE)
    return np.stack([knots[:-1][begins], inverse, np.cumsum(counts) - counts, counts], axis=1)


def _head(array: "wp.array", count: int) -> "wp.array":
    """A copy of the first entries, so that the rest can be freed."""
    head = wp.empty(count, dtype=array.dtype, device=array.device)
    if count:
        wp.copy(head, array, count=count)
    return head


def _table_shift(cell_count: int, point_count: int) -> int:
    """Least number of low key bits that the table must leave to a search to stay within its size."""
    limit = TABLE_ENTRIES_PER_POINT * point_count + TABLE_ENTRIES_MORE
    shift = 0
    while (cell_count >> shift) + 2 > limit:
        shift += 1
    return shift
