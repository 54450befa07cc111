"""Points sorted by cell: the one structure behind every neighbour search, with memory bounded by the points alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit import _launch
from geokit.errors import InputError

if TYPE_CHECKING:
    import warp as wp

__all__ = ["Cells", "build_cells", "crowd_box", "points_box"]

# Each axis is cut into this many intervals of about equally many points. An interval too long for cells of the radius
# gets longer cells of its own, the others keep theirs: one far point, or clusters far apart, must not leave a crowd in
# a single cell.
INTERVALS = 64
# Three axes of 64 intervals of 2^14 cells leave a key room in 63 bits.
MAX_CELLS_PER_INTERVAL = 1 << 14
# More cells on an interval than it has points separate nothing more; few points still get this many.
MIN_CELLS_PER_INTERVAL = 16
# Points whose coordinates decide the intervals: 64 for each, which puts a quarter of the wanted number of points more
# or less into one.
SAMPLE_SIZE = 4096
# The inverse of a cell's edge stays finite, so that its product with a coordinate does: longer cells than the radius
# cost time, never neighbours.
MAX_INVERSE_EDGE = 1e300
# The table has at most this many entries for each point and on top of them the second figure, whatever the extent:
# 16 bytes a point and 256 KiB. Four leaves most tables of evenly spread points direct.
TABLE_ENTRIES_PER_POINT = 4
TABLE_ENTRIES_MORE = 1 << 16
# A run of table entries is 64 binary searches long at worst: a slice of few of them is worth a thread.
TABLE_GRAIN = 16
BOUNDS_GRAIN = 8


@dataclass(frozen=True, eq=False)
class Cells:
    """Sorted points on a device.

    Attributes:
        grid: The kernels' view of them, a CellGrid.
        radius: The search radius [world] that the cells are made for.
    """

    grid: Any
    radius: float


def points_box(points: "wp.array") -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper corner of the box around vec3d points [world]; zeros where there are none.

    Raises:
        InputError: The points spread over more than a float64 can hold.
    """
    import warp as wp

    from geokit.points import _cells_kernels as kernels

    device: Any = points.device
    if len(points) == 0:
        return np.zeros(3), np.zeros(3)
    run_count = -(-len(points) // int(kernels.BOUNDS_RUN))
    lowers = wp.empty(run_count, dtype=wp.vec3d, device=device)
    uppers = wp.empty(run_count, dtype=wp.vec3d, device=device)
    _launch.launch(kernels.bounds_kernel, run_count, [points], [lowers, uppers], device, grain=BOUNDS_GRAIN)
    lower, upper = lowers.numpy().min(axis=0), uppers.numpy().max(axis=0)
    with np.errstate(over="ignore"):
        if not np.isfinite(upper - lower).all():
            raise InputError(
                f"points: they spread from {lower.tolist()} to {upper.tolist()}, more than a float64 can hold; "
                "scale them down"
            )
    return lower, upper


def crowd_box(points: "wp.array") -> tuple[list[float], float]:
    """Lower corner and longest edge of a box around all but the outermost points on each axis [world]."""
    if len(points) == 0:
        return [0.0, 0.0, 0.0], 0.0
    ascending = np.sort(_sample(points), axis=0)
    outermost = len(ascending) // INTERVALS
    lower, upper = ascending[outermost], ascending[-1 - outermost]
    return lower.tolist(), float((upper - lower).max())


def build_cells(points: "wp.array", lower: NDArray[np.float64], upper: NDArray[np.float64], radius: float) -> Cells:
    """Points sorted by cells of about the radius.

    Args:
        points: vec3d positions (N,) [world]; copied.
        lower: Lower corner of their box [world].
        upper: Upper corner of their box [world].
        radius: Edge length of a cell [world] where the extent allows it.
    Returns:
        Cells: 28 bytes a point, 8 more where the table is not direct, and up to 16 for the table stay in use; 28 more
        while they are made.
    """
    import warp as wp

    from geokit.points import _cells_kernels as kernels

    device: Any = points.device
    count = len(points)
    grid: Any = kernels.CellGrid()
    grid.lower, grid.upper = wp.vec3d(*lower.tolist()), wp.vec3d(*upper.tolist())
    cell_count = _cut_axes(grid, points, lower, upper, radius)
    grid.shift = _table_shift(cell_count, count)

    # radix_sort_pairs uses the second half of both arrays as scratch space.
    keys = wp.empty(2 * count, dtype=wp.int64, device=device)
    order = wp.empty(2 * count, dtype=wp.int32, device=device)
    _launch.launch(kernels.key_kernel, count, [points, grid], [keys, order], device)
    if count:
        wp.utils.radix_sort_pairs(keys, order, count, end_bit=max(1, (cell_count - 1).bit_length()))
    grid.index = _head(order, count)

    # Vectors are read past the end of the last row; what they find there is masked out.
    padded = count + int(kernels.MASK_BITS)
    grid.x = wp.zeros(padded, dtype=wp.float64, device=device)
    grid.y = wp.zeros(padded, dtype=wp.float64, device=device)
    grid.z = wp.zeros(padded, dtype=wp.float64, device=device)
    _launch.launch(kernels.gather_kernel, count, [points, grid.index], [grid.x, grid.y, grid.z], device)

    grid.start = wp.empty((cell_count >> grid.shift) + 2, dtype=wp.int32, device=device)
    run_count = -(-len(grid.start) // int(kernels.TABLE_RUN))
    _launch.launch(kernels.table_kernel, run_count, [keys, count, grid.shift], [grid.start], device, grain=TABLE_GRAIN)
    # With a direct table no key is read again.
    grid.key = _head(keys, count if grid.shift else 0)
    return Cells(grid=grid, radius=radius)


def _cut_axes(
    grid: Any, points: "wp.array", lower: NDArray[np.float64], upper: NDArray[np.float64], radius: float
) -> int:
    """Cuts the three axes into cells for the grid; returns the number of cells in all."""
    import warp as wp

    sample = _sample(points)
    most = min(max(len(points) // INTERVALS, MIN_CELLS_PER_INTERVAL), MAX_CELLS_PER_INTERVAL)
    tables, sizes, first = [], [], 0
    for axis in range(3):
        table = _intervals(sample[:, axis], lower[axis], upper[axis], radius, most)
        grid.first_knot[axis], grid.last_knot[axis] = first, first + len(table[0]) - 1
        first += len(table[0])
        tables.append(table)
        sizes.append(int(table[3].sum()))
    dtypes = (wp.float64, wp.float64, wp.int32, wp.int32)
    grid.knot, grid.inverse_edge, grid.first_cell, grid.cell_count = (
        wp.array(np.concatenate(columns), dtype=dtype, device=points.device)
        for columns, dtype in zip(zip(*tables, strict=True), dtypes, strict=True)
    )
    grid.count_x, grid.count_y = sizes[0], sizes[1]
    return sizes[0] * sizes[1] * sizes[2]


def _intervals(
    sample: NDArray[np.float64], lower: float, upper: float, radius: float, most: int
) -> tuple[NDArray[Any], ...]:
    """Begin, inverse cell edge, first cell and number of cells of an axis's intervals.

    Intervals between quantiles that need more than ``most`` cells of the radius get so many; between others nothing is
    to be separated, and they become one.
    """
    inner = np.sort(sample)[np.arange(1, INTERVALS) * len(sample) // INTERVALS] if len(sample) else sample
    knots = np.unique(np.concatenate([[lower, upper], inner]))
    if len(knots) == 1:
        # No extent: one cell, which the clamp gives to every coordinate.
        return knots, np.ones(1), np.zeros(1, dtype=np.int64), np.ones(1, dtype=np.int64)
    is_long = np.diff(knots) > radius * most
    begins = np.concatenate([[True], is_long[1:] | is_long[:-1]])
    width = np.diff(np.append(knots[:-1][begins], upper))
    with np.errstate(over="ignore"):
        counts = np.where(is_long[begins], most, np.maximum(np.ceil(width / radius), 1.0))
        inverse = np.minimum(counts / width, MAX_INVERSE_EDGE)
    cells = counts.astype(np.int64)
    return knots[:-1][begins], inverse, np.cumsum(cells) - cells, cells


def _sample(points: "wp.array") -> NDArray[np.float64]:
    """Coordinates of some of the points, evenly over their order."""
    import warp as wp

    from geokit.points import _cells_kernels as kernels

    device: Any = points.device
    count = min(len(points), SAMPLE_SIZE)
    taken = wp.empty(count, dtype=wp.vec3d, device=device)
    _launch.launch(kernels.sample_kernel, count, [points, count], [taken], device)
    return taken.numpy()


def _head(array: "wp.array", count: int) -> "wp.array":
    """A copy of the first entries, so that the rest can be let go of."""
    import warp as wp

    head = wp.empty(count, dtype=array.dtype, device=array.device)
    if count:
        wp.copy(head, array, count=count)
    return head


def _table_shift(cell_count: int, point_count: int) -> int:
    """Fewest low bits of a key that the table must leave to a search to stay within its size."""
    limit = TABLE_ENTRIES_PER_POINT * point_count + TABLE_ENTRIES_MORE
    shift = 0
    while (cell_count >> shift) + 2 > limit:
        shift += 1
    return shift
