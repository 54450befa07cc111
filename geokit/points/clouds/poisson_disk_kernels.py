"""Rounds of a greedy maximal independent set: points that precede all their undecided neighbors are taken.

The undecided points are those of a CellGrid, numbered in the order in which they are tried. Threads write a state
concurrently only with the same value, and no kernel reads what it writes in any other way.
"""

# mypy: ignore-errors
import warp as wp

from geokit.points.search.cells_kernels import MASK_BITS, CellGrid
from geokit.points.search.neighbors_kernels import cells_around, lowest_bit, row_count, row_range, within_mask

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

WAITING = wp.constant(wp.int8(0))
TAKEN = wp.constant(wp.int8(1))
REFUSED = wp.constant(wp.int8(2))


@wp.func
def comes_before(
    grid: CellGrid, begin: wp.int32, end: wp.int32, q: wp.vec3d, limit: wp.float64, number: wp.int32
) -> wp.bool:
    """Whether one of the next MASK_BITS sorted points is near q and has a lower number."""
    mask = within_mask(grid, begin, end, q, limit)
    while mask != wp.uint64(0):
        if grid.index[begin + lowest_bit(mask)] < number:
            return True
        mask = mask & (mask - wp.uint64(1))
    return False


@wp.func
def is_first(i: wp.int32, grid: CellGrid, reach: wp.float64, limit: wp.float64) -> wp.bool:
    """Whether no neighbor of the sorted point i is tried before it."""
    q = wp.vec3d(grid.x[i], grid.y[i], grid.z[i])
    number = grid.index[i]
    # First the points of its own cell with the lowest numbers: among many neighbors these usually decide.
    own = row_range(grid, cells_around(grid, q, wp.float64(0.0)), 0)
    if comes_before(grid, own[0], own[1], q, limit, number):
        return False
    box = cells_around(grid, q, reach)
    for row in range(row_count(box)):
        span = row_range(grid, box, row)
        for begin in range(span[0], span[1], MASK_BITS):
            if comes_before(grid, begin, span[1], q, limit, number):
                return False
    return True


@wp.kernel
def take_kernel(first: int, grid: CellGrid, reach: wp.float64, limit: wp.float64, out_state: wp.array(dtype=wp.int8)):
    """Take the points that are tried before all their neighbors."""
    i = first + wp.tid()
    if is_first(i, grid, reach, limit):
        out_state[i] = TAKEN


@wp.kernel
def refuse_kernel(first: int, grid: CellGrid, reach: wp.float64, limit: wp.float64, out_state: wp.array(dtype=wp.int8)):
    """Reject the neighbors of the taken points; no two taken points are neighbors."""
    i = first + wp.tid()
    if out_state[i] == TAKEN:
        q = wp.vec3d(grid.x[i], grid.y[i], grid.z[i])
        box = cells_around(grid, q, reach)
        for row in range(row_count(box)):
            span = row_range(grid, box, row)
            for begin in range(span[0], span[1], MASK_BITS):
                mask = within_mask(grid, begin, span[1], q, limit)
                while mask != wp.uint64(0):
                    j = begin + lowest_bit(mask)
                    mask = mask & (mask - wp.uint64(1))
                    if j != i:
                        out_state[j] = REFUSED


@wp.kernel
def outcome_kernel(
    first: int,
    grid: CellGrid,
    state: wp.array(dtype=wp.int8),
    waiting: wp.array(dtype=wp.int32),
    out_left: wp.array(dtype=wp.int32),
    out_taken: wp.array(dtype=wp.int32),
):
    """1 for points still waiting, by number, and for points taken, by index among all points."""
    i = first + wp.tid()
    number = grid.index[i]
    out_left[number] = wp.where(state[i] == WAITING, 1, 0)
    if state[i] == TAKEN:
        out_taken[waiting[number]] = 1
