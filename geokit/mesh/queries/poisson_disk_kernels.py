"""Dart throwing: a candidate is taken if no point taken before is nearer than the radius.

One thread processes all candidates: each decision depends on the previous ones, and a serial sweep over a hash grid
takes about 0.3 us per candidate.
"""

# mypy: ignore-errors
import warp as wp

# Fused multiply-adds would round squared distances differently from what callers can compute themselves.
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})


@wp.struct
class DartGrid:
    """The taken points in linked lists, one for each bucket of hashed cells; -1 ends a list.

    A cell is at least twice as long as the radius, so that a ball touches at most two cells per axis. Cells that share
    a bucket cost time but never change a result: the distance to every point of a list is measured.
    """

    points: wp.array(dtype=wp.vec3d)
    head: wp.array(dtype=int)
    next: wp.array(dtype=int)
    lower: wp.vec3d
    cells_per_unit: wp.float64
    bucket_mask: wp.int64


@wp.func
def cell_of(grid: DartGrid, offset: wp.float64) -> wp.int32:
    """Cell along one axis; cells are so long that its number stays below 2^30."""
    return wp.int32(wp.floor(offset * grid.cells_per_unit))


@wp.func
def bucket_of(grid: DartGrid, x: wp.int32, y: wp.int32, z: wp.int32) -> wp.int32:
    # Large odd factors spread neighboring cells. The high half is mixed in, because the mask keeps only low bits.
    mixed = (wp.int64(x) * wp.int64(73856093)) ^ (wp.int64(y) * wp.int64(19349663)) ^ (wp.int64(z) * wp.int64(83492791))
    mixed = mixed ^ (mixed >> wp.int64(17))
    return wp.int32(mixed & grid.bucket_mask)


@wp.func
def insert(grid: DartGrid, slot: wp.int32):
    offset = grid.points[slot] - grid.lower
    bucket = bucket_of(grid, cell_of(grid, offset[0]), cell_of(grid, offset[1]), cell_of(grid, offset[2]))
    grid.next[slot] = grid.head[bucket]
    grid.head[bucket] = slot


@wp.func
def nearest_squared(grid: DartGrid, p: wp.vec3d, reach: wp.float64, enough: wp.float64) -> wp.float64:
    """Squared distance to the nearest taken point within ``reach``, or to any taken point nearer than ``enough``."""
    offset = p - grid.lower
    least = wp.float64(wp.inf)
    # No statement leaves three loops at once: after the answer is known, the loops run on without work.
    for x in range(cell_of(grid, offset[0] - reach), cell_of(grid, offset[0] + reach) + 1):
        for y in range(cell_of(grid, offset[1] - reach), cell_of(grid, offset[1] + reach) + 1):
            for z in range(cell_of(grid, offset[2] - reach), cell_of(grid, offset[2] + reach) + 1):
                slot = int(-1)
                if least >= enough:
                    slot = grid.head[bucket_of(grid, x, y, z)]
                while slot >= 0:
                    d = p - grid.points[slot]
                    squared = (d[0] * d[0] + d[1] * d[1]) + d[2] * d[2]
                    least = wp.min(least, squared)
                    slot = grid.next[slot]
                    if least < enough:
                        slot = -1
    return least


@wp.kernel
def insert_kernel(first: int, count: int, grid: DartGrid):
    """Build lists of the points ``0 .. count - 1``; one thread, so that their order is that of dart throwing."""
    for slot in range(count):
        insert(grid, slot)


@wp.kernel
def throw_kernel(
    first: int,
    candidates: wp.array(dtype=wp.vec3d),
    grid: DartGrid,
    radius_squared: wp.float64,
    reach: wp.float64,
    wanted: int,
    out_nearest: wp.array(dtype=wp.float64),
    out_taken: wp.array(dtype=int),
    out_count: wp.array(dtype=int),
):
    """Take candidates in order until ``wanted`` are taken.

    ``out_nearest`` holds the squared distance of each candidate from some taken point; a candidate below the radius is
    skipped. ``out_taken`` lists the candidates that became points, ``out_count[0]`` their number.
    """
    count = out_count[0]
    i = int(0)
    while i < candidates.shape[0] and count < wanted:
        if out_nearest[i] >= radius_squared:
            p = candidates[i]
            squared = nearest_squared(grid, p, reach, radius_squared)
            out_nearest[i] = wp.min(out_nearest[i], squared)
            if squared >= radius_squared:
                # Zero: taken, and skipped from now on.
                out_nearest[i] = wp.float64(0.0)
                grid.points[count] = p
                out_taken[count] = i
                insert(grid, count)
                count += 1
        i += 1
    out_count[0] = count
