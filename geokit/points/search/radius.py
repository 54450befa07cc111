"""Radius search over sorted points: queries are ordered, neighbors counted, and rows filled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory import available_memory, host_pool
from geokit.core.scan import gathered, prefix_sum, row_offsets
from geokit.errors import DeviceMemoryError
from geokit.points.search.cells import Cells, has_groups, sorted_keys

if TYPE_CHECKING:
    from geokit.points.search.periodic import Images

# Bytes of an entry: int32 index and float64 distance.
BYTES_PER_NEIGHBOR = 12
# One flat array holds the neighbors of all queries, with int32 positions.
MAX_NEIGHBORS = 2**31 - 1
# Offset from a query's index that matches no point: nothing is left out.
NOTHING_LEFT_OUT = -(2**30) * 2
# Items of a launch are counted in int32, and each row has 32.
ROWS_AT_ONCE = 1 << 25
# Shares that are worth a slice: a tenth of a millisecond of work, the time that waking a thread takes.
SEARCH_GRAIN = 8
# Most numbers for the notes of a count, 48 MiB, and the least and greatest number for each query of a share. Queries
# beyond this space, and queries with more neighbors, are searched twice.
NOTED = 48 << 18
LEAST_NOTED, MOST_NOTED = 64, 1024
# With fewer queries than this, searching twice is faster than allocating notes.
FEWEST_NOTED = 1 << 11
# Radii within this factor of each other share the same cells: more classes sort the points more often, fewer classes
# read more points.
CLASS_RATIO = 4.0


class Notes(NamedTuple):
    """Results of a count, stored so that the fill need not search again.

    Attributes:
        size: Numbers of each share of the queries.
        places: For each share, as long as there is space: whether its notes are complete, and for each query the number
            of its neighbors and their positions among the sorted points.
    """

    size: int
    places: Any


class Asked:
    """Queries with their radii, and the cells that suit them.

    Args:
        rows: Queries on the device, vec3d (vec3f too on a GPU), shape (Q,); None for the first ``count`` points.
        count: Q.
        radius: One radius for all, or an array (Q,) of float64 on the host.
        cells_for: Returns the cells for a radius.
        own: True if neighbor i of query i is left out.
        group: Group of each query, int32 on the device, if the points are in groups; not needed without rows.
        first_point: Index of the point that query 0 stands for, which ``own`` leaves out.
    """

    def __init__(
        self,
        rows: Any,
        count: int,
        radius: Any,
        cells_for: Callable[[float], Cells],
        device: "wp.Device",
        *,
        own: bool,
        first_point: int = 0,
        group: Any = None,
    ) -> None:
        self.count, self.device, self.own, self.first_point = count, device, own, first_point
        self.rows = rows
        values = np.atleast_1d(np.asarray(radius, dtype=np.float64))
        # One number goes with the launch that writes it, so that a graph may capture it.
        if len(values) == 1:
            self.radius: Any = wp.full(1, float(values[0]), dtype=wp.float64, device=device)
        else:
            self.radius = wp.array(values, dtype=wp.float64, device=device)
        # Each part: cells, and their queries in an order in which consecutive queries share what they read.
        self.parts: list[tuple[Any, Any, int]] = []
        for most, chosen in _classes(values, count):
            grid = cells_for(most).grid
            number = count if chosen is None else len(chosen)
            queries = _own_queries(grid, count) if rows is None and chosen is None else None
            if queries is None:
                given, numbers = (points_of(grid), grid.group) if rows is None else (rows, group)
                queries = _arranged(grid, given, chosen, device, numbers if has_groups(grid) else None)
            self.parts.append((grid, queries, number))
        # Of queries in a periodic cell, by how many cells they were outside; None for the points themselves.
        self.turn: Any = None
        # Images among which neighbors are found, in a periodic cell.
        self.images: Images | None = None
        # Results of the count, for each part.
        self.notes: list[Notes | None] = [None] * len(self.parts)


def _classes(radius: np.ndarray, count: int) -> list[tuple[float, np.ndarray | None]]:
    """Largest radius of each class of similar radii, and the queries of the class; None for all queries."""
    if len(radius) != count or count < 2:
        return [(float(radius[0]), None)] if len(radius) else []
    largest, smallest = float(radius.max()), float(radius.min())
    if largest <= CLASS_RATIO * smallest:
        return [(largest, None)]
    with np.errstate(divide="ignore"):
        # Radii of 0 join the class of the smallest positive radius.
        size = np.log(np.maximum(radius, radius[radius > 0.0].min())) / np.log(CLASS_RATIO)
    number = np.floor(size - size.min()).astype(np.int64)
    parts = (np.flatnonzero(number == value) for value in np.unique(number))
    return [(float(radius[part].max()), part.astype(np.int32)) for part in parts]


def _own_queries(grid: Any, count: int) -> Any:
    """The points as queries in the order of the cells, or the first ``count`` of them: others are images."""
    from geokit.points.search.neighbors_kernels import Queries
    from geokit.points.search.radius_cuda_kernels import own_flag_kernel, own_query_kernel

    queries: Any = Queries()
    if count < len(grid.index):
        device = grid.index.device
        flags = wp.empty(len(grid.index), dtype=wp.int32, device=device)
        launcher.launch(own_flag_kernel, len(flags), [grid.index, count], [flags], device)
        places, _ = prefix_sum(flags)
        queries.x, queries.y, queries.z = (wp.empty(count, dtype=wp.float64, device=device) for _ in range(3))
        queries.index = wp.empty(count, dtype=wp.int32, device=device)
        launcher.launch(own_query_kernel, len(flags), [grid, flags, places], [queries], device)
        return queries
    queries.x, queries.y, queries.z, queries.index = grid.x, grid.y, grid.z, grid.index
    if has_groups(grid):
        queries.group = grid.group
    return queries


def points_of(grid: Any) -> "wp.array":
    """The points as vec3d in their original order."""
    from geokit.points.search.cells_kernels import unsort_kernel

    count, device = len(grid.index), grid.index.device
    points = wp.empty(count, dtype=wp.vec3d, device=device)
    launcher.launch(unsort_kernel, count, [grid], [points], device)
    return points


def _arranged(grid: Any, rows: "wp.array", chosen: np.ndarray | None, device: "wp.Device", group: Any) -> Any:
    """Queries sorted by cell, only those of ``chosen`` if given, with the group of each if there are any."""
    from geokit.core.sorting.gather_kernels import GATHER
    from geokit.points.search import radius_cuda_kernels as kernels
    from geokit.points.search.neighbors_kernels import Queries

    if chosen is not None:
        places = wp.array(chosen, dtype=wp.int32, device=device)
        rows = gathered(rows, places)
        group = None if group is None else wp.array(group.numpy()[chosen], dtype=wp.int32, device=device)
    count = len(rows)
    if count < launcher.MINIMUM_ORDERED:
        order = launcher.identity(device)
    else:
        _, order = sorted_keys(grid, rows, group)
    queries: Any = Queries()
    if group is not None:
        # The queries are packed by group and keys ascend with the groups: sorted, a place is in the same group.
        queries.group = group
    queries.x, queries.y, queries.z = (wp.empty(count, dtype=wp.float64, device=device) for _ in range(3))
    queries.index = wp.empty(count, dtype=wp.int32, device=device)
    launcher.launch(kernels.ARRANGE[rows.dtype], count, [rows, order], [queries], device)
    if chosen is not None:
        # From numbers among the chosen to those of all.
        launcher.launch(GATHER[wp.int32], count, [places, queries.index], [queries.index], device)
    return queries


def count(asked: Asked, *, note: bool = False) -> "wp.array":
    """Number of neighbors of each query, int32 (Q,).

    With ``note`` a CPU stores the neighbors that it finds in ``asked``, for :func:`fill`.
    """
    from geokit.points.search.radius_cpu_kernels import count_share_kernel
    from geokit.points.search.radius_cuda_kernels import UNCOUNT, count_in_groups_kernel, count_kernel

    device = asked.device
    counts = wp.empty(asked.count, dtype=wp.int32, device=device)
    # A point is its own neighbor, but a query that stands for a point may lie elsewhere and not find it.
    own = int(asked.own and asked.rows is None)
    for part, (grid, queries, number) in enumerate(asked.parts):
        given = [queries, grid, asked.radius, own]
        if device.is_cpu:
            size, places = asked.notes[part] = _room_for_notes(number if note else 0, device)
            launch_shares(count_share_kernel, number, [*given, size], [counts, places], device)
        else:
            kernel = count_in_groups_kernel if has_groups(grid) else count_kernel
            launcher.launch(kernel, number, given, [counts], device)
    if asked.own and asked.rows is not None and asked.count:
        points = points_of(asked.parts[0][0])
        given = [points, asked.rows, asked.first_point, asked.radius]
        launcher.launch(UNCOUNT[asked.rows.dtype], asked.count, given, [counts], device)
    return counts


def _room_for_notes(queries: int, device: "wp.Device") -> Notes:
    from geokit.points.search.radius_cpu_kernels import SHARE

    if queries < FEWEST_NOTED:
        return Notes(0, wp.empty(0, dtype=wp.int32, device=device))
    shares = -(-queries // int(SHARE))
    size = min(max(NOTED // shares, LEAST_NOTED * int(SHARE)), MOST_NOTED * int(SHARE))
    return Notes(size, host_pool.empty_warp(size * min(shares, NOTED // size), wp.int32, device))


def notes_bytes(queries: int, device: "wp.Device") -> int:
    """Most memory that the notes of a count take."""
    return 4 * NOTED if device.is_cpu and queries >= FEWEST_NOTED else 0


def launch_shares(kernel: Any, queries: int, inputs: list[Any], outputs: list[Any], device: "wp.Device") -> None:
    """Launch over shares of queries with common cells on a CPU, over single queries on a GPU."""
    from geokit.points.search.radius_cpu_kernels import SHARE

    launcher.launch(kernel, -(-queries // int(SHARE)), inputs, outputs, device, grain=SEARCH_GRAIN)


def fill(
    asked: Asked, counts: "wp.array", refuse: Callable[[int], None], *, order: str = "index", single: bool = False
) -> tuple[Any, Any, Any]:
    """offsets (Q + 1,) int64, indices (M,) int32 and distance (M,) float64 of rows with the lengths ``counts``.

    ``refuse`` is called with M before allocation, to raise if M is too large. ``order`` is "index", or "any" for the
    order of the cells. With ``single`` a CPU returns distance in float32.
    """
    from geokit.points.search.radius_cpu_kernels import FILL_OF
    from geokit.points.search.radius_cuda_kernels import fill_in_groups_kernel, fill_kernel

    device = asked.device
    offsets = row_offsets(counts)
    total = int(offsets[asked.count :].numpy()[0])
    refuse(total)
    single = single and device.is_cpu
    # NumPy asks for large pages: rows are written all over it.
    indices = host_pool.empty_warp(total, wp.int32, device)
    distance = host_pool.empty_warp(total, wp.float32 if single else wp.float64, device)
    own = asked.first_point if asked.own else NOTHING_LEFT_OUT
    for part, (grid, queries, number) in enumerate(asked.parts):
        given = [queries, grid, asked.radius, own, offsets]
        if device.is_cpu:
            given += [*(asked.notes[part] or _room_for_notes(0, device)), order == "index"]
            launch_shares(FILL_OF[distance.dtype], number, given, [indices, distance], device)
        else:
            kernel = fill_in_groups_kernel if has_groups(grid) else fill_kernel
            launcher.launch(kernel, number, given, [indices, distance], device)
    if device.is_cuda and order == "index":
        sort_by_index(offsets, indices, distance)
    return offsets, indices, distance


def crowding(cells: Cells) -> float:
    """Mean over the points of the number of points in their cell."""
    from geokit.points.search import cells_kernels as kernels

    start = cells.grid.start
    device: Any = start.device
    points = len(cells.grid.index)
    runs = -(-len(start) // int(kernels.CROWDING_RUN))
    sums = wp.empty(runs, dtype=wp.int64, device=device)
    launcher.launch(kernels.crowding_kernel, runs, [start], [sums], device)
    return float(sums.numpy().sum()) / points if points else 0.0


def sort_by_index(offsets: "wp.array", indices: "wp.array", distance: "wp.array") -> None:
    """Sort rows by ascending index; on a CPU they are filled in this order."""
    from geokit.points.search.radius_cuda_kernels import sort_rows_kernel

    device: Any = offsets.device
    rows = len(offsets) - 1
    # The threads of a CUDA warp are adjacent items: blocks of rows begin at a multiple of 32.
    for begin in range(0, rows, ROWS_AT_ONCE):
        part = offsets[begin : min(begin + ROWS_AT_ONCE, rows) + 1]
        launcher.launch(sort_rows_kernel, 32 * (len(part) - 1), [part], [indices, distance], device)


def sort_by_distance(offsets: "wp.array", indices: "wp.array", distance: "wp.array") -> None:
    """Sort rows by ascending (distance, index) instead of index."""
    from geokit.points.search.radius_cuda_kernels import sort_by_distance_kernel

    device: Any = offsets.device
    launcher.launch(sort_by_distance_kernel, len(offsets) - 1, [offsets], [indices, distance], device)


def require_room(total: int, query_count: int, device: "wp.Device", each: int = BYTES_PER_NEIGHBOR) -> None:
    """Raise DeviceMemoryError if the neighbors, of ``each`` bytes, exceed the free memory or the size of one result."""
    what = f"radius_search: {query_count} queries have {total} neighbors"
    remedy = "use a smaller radius, fewer queries at a time, radius_search_blocks() or count()"
    available_memory.require_room(total * each, f"{what}, which need", remedy, device)
    if total > MAX_NEIGHBORS:
        raise DeviceMemoryError(f"{what}; one result holds at most {MAX_NEIGHBORS}: {remedy}")


def blocks_of(counts: np.ndarray, budget: int) -> Iterator[tuple[int, int]]:
    """Begin and end of blocks of consecutive rows whose neighbors take at most ``budget`` bytes.

    A row longer than the budget is a block of its own.
    """
    ends = np.cumsum(counts, dtype=np.int64) * BYTES_PER_NEIGHBOR
    most = min(budget, MAX_NEIGHBORS * BYTES_PER_NEIGHBOR)
    begin, passed = 0, 0
    while begin < len(counts):
        end = max(begin + 1, int(np.searchsorted(ends, passed + most, side="right")))
        yield begin, end
        begin, passed = end, int(ends[end - 1])
