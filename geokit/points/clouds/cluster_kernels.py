"""Density-based clusters: core points are joined in a union-find while the rows of cells around them are read.

Positions are those of the sorted points, so that the neighbors of a point are also close in memory.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core.atomic_kernels import lower_to, root_of, unite
from geokit.points.search.cells_kernels import MASK_BITS, CellGrid
from geokit.points.search.neighbors_kernels import cells_around, lowest_bit, reach_of, row_count, row_range, within_mask

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})


@wp.kernel
def start_kernel(
    first: int,
    grid: CellGrid,
    count: wp.array(dtype=wp.int32),
    minimum_count: wp.int32,
    out_core: wp.array(dtype=wp.uint8),
    out_parent: wp.array(dtype=wp.int32),
):
    """Mark the sorted points that are core points; each starts as a set of its own."""
    s = first + wp.tid()
    out_parent[s] = s
    out_core[s] = wp.uint8(0)
    if count[grid.index[s]] >= minimum_count:
        out_core[s] = wp.uint8(1)


@wp.kernel
def join_kernel(
    first: int,
    grid: CellGrid,
    radius: wp.float64,
    core: wp.array(dtype=wp.uint8),
    out_parent: wp.array(dtype=wp.int32),
):
    """Join each core point with the core points within the radius that precede it in sorted order."""
    s = first + wp.tid()
    if core[s] == wp.uint8(0):
        return
    q = wp.vec3d(grid.x[s], grid.y[s], grid.z[s])
    box = cells_around(grid, q, reach_of(radius))
    for row in range(row_count(box)):
        span = row_range(grid, box, row)
        # Being neighbors is symmetric: half of the pairs suffice.
        end = wp.min(span[1], s)
        for begin in range(span[0], end, MASK_BITS):
            mask = within_mask(grid, begin, end, q, radius * radius)
            while mask != wp.uint64(0):
                j = begin + lowest_bit(mask)
                mask = mask & (mask - wp.uint64(1))
                # Most neighbors are already in the same set, and most of those have the same parent.
                if core[j] != wp.uint8(0) and out_parent[j] != out_parent[s]:
                    unite(out_parent, s, j)


@wp.kernel
def lowest_kernel(
    first: int,
    grid: CellGrid,
    core: wp.array(dtype=wp.uint8),
    parent: wp.array(dtype=wp.int32),
    out_root: wp.array(dtype=wp.int32),
    out_lowest: wp.array(dtype=wp.int32),
):
    """Root of each core point, and the lowest index of a point for each root."""
    s = first + wp.tid()
    if core[s] != wp.uint8(0):
        root = root_of(parent, s)
        out_root[s] = root
        lower_to(out_lowest, root, grid.index[s])


@wp.kernel
def mark_kernel(
    first: int,
    core: wp.array(dtype=wp.uint8),
    root: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    out_mark: wp.array(dtype=wp.int32),
):
    """1 at the lowest index of each cluster's core points."""
    s = first + wp.tid()
    if core[s] != wp.uint8(0) and root[s] == s:
        out_mark[lowest[s]] = 1


@wp.func
def nearest_core(grid: CellGrid, s: wp.int32, radius: wp.float64, core: wp.array(dtype=wp.uint8)) -> wp.int32:
    """Sorted position of the nearest core point within the radius of a point, -1 if there is none."""
    q = wp.vec3d(grid.x[s], grid.y[s], grid.z[s])
    box = cells_around(grid, q, reach_of(radius))
    best = wp.int32(-1)
    least = wp.float64(0.0)
    for row in range(row_count(box)):
        span = row_range(grid, box, row)
        for begin in range(span[0], span[1], MASK_BITS):
            mask = within_mask(grid, begin, span[1], q, radius * radius)
            while mask != wp.uint64(0):
                j = begin + lowest_bit(mask)
                mask = mask & (mask - wp.uint64(1))
                if core[j] != wp.uint8(0):
                    dx = grid.x[j] - q[0]
                    dy = grid.y[j] - q[1]
                    dz = grid.z[j] - q[2]
                    d = (dx * dx + dy * dy) + dz * dz
                    if best < 0 or d < least or (d == least and grid.index[j] < grid.index[best]):
                        best = j
                        least = d
    return best


@wp.kernel
def label_kernel(
    first: int,
    grid: CellGrid,
    radius: wp.float64,
    core: wp.array(dtype=wp.uint8),
    root: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    number: wp.array(dtype=wp.int32),
    out_label: wp.array(dtype=wp.int32),
):
    """Cluster number of each point; a point that is not core joins its nearest core point, or is noise, -1."""
    s = first + wp.tid()
    at = s
    if core[s] == wp.uint8(0):
        at = nearest_core(grid, s, radius, core)
    label = wp.int32(-1)
    if at >= 0:
        label = number[lowest[root[at]]]
    out_label[grid.index[s]] = label
