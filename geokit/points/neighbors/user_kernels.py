"""The neighbors of a point, one after the other, for the user's own kernels: :mod:`geokit.kernels`."""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.points.search.cells_kernels import MASK_BITS, CellGrid
from geokit.points.search.neighbors_kernels import (
    CellBox,
    Nearness,
    cells_around,
    lowest_bit,
    nearness_of,
    reach_of,
    row_count,
    row_range,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class NeighborGrid:
    """Points sorted by cells in kernels, by :meth:`geokit.points.NeighborGrid.on_kernel`; its fields may change."""

    cells: CellGrid


@wp.struct
class Neighbor:
    """A neighbor, and where the search for the next one goes on.

    Attributes:
        index: Its index among the points of the grid; -1 where there is no further one.
        distance: Its distance from the query [world].
    """

    index: int
    distance: wp.float64
    # The search: the query, the cells around it, the rows and points of these that are left, and those that are within
    # the radius among up to 64 from ``place`` on.
    point: wp.vec3d
    squared: wp.float64
    near: Nearness
    box: CellBox
    row: int
    rows: int
    begin: int
    end: int
    place: int
    mask: wp.uint64


@wp.func
def sorted_point(grid: NeighborGrid, place: int) -> int:
    """Index of a point in the order of the cells: threads in this order read the same cells, which is faster on a GPU.

    Args:
        grid: ``grid.on_kernel()``.
        place: From 0 to the number of points - 1.
    """
    return grid.cells.index[place]


@cpp.func_native("points/search/near.inl")
def neighbor_mask(
    grid: CellGrid, begin: wp.int32, end: wp.int32, near: Nearness, q: wp.vec3d, limit: wp.float64
) -> wp.uint64: ...


@wp.func
def next_neighbor(grid: NeighborGrid, last: Neighbor) -> Neighbor:
    """The neighbor after another one, in no certain order; its index is -1 where there is none.

    Args:
        grid: ``grid.on_kernel()``.
        last: The neighbor before, by :func:`first_neighbor` or this function.
    """
    found = last
    found.index = -1
    while found.mask == wp.uint64(0) and (found.begin < found.end or found.row < found.rows):
        if found.begin < found.end:
            found.place = found.begin
            found.mask = neighbor_mask(grid.cells, found.begin, found.end, found.near, found.point, found.squared)
            found.begin = found.begin + MASK_BITS
        else:
            span = row_range(grid.cells, found.box, found.row)
            found.begin = span[0]
            found.end = span[1]
            found.row = found.row + 1
    if found.mask != wp.uint64(0):
        j = found.place + lowest_bit(found.mask)
        found.mask = found.mask & (found.mask - wp.uint64(1))
        dx = grid.cells.x[j] - found.point[0]
        dy = grid.cells.y[j] - found.point[1]
        dz = grid.cells.z[j] - found.point[2]
        found.distance = wp.sqrt((dx * dx + dy * dy) + dz * dz)
        found.index = grid.cells.index[j]
    return found


@wp.func
def first_neighbor(grid: NeighborGrid, point: wp.vec3d, radius: wp.float64) -> Neighbor:
    """The first of the points within a radius: those of :meth:`geokit.points.NeighborGrid.radius_search`.

    A point of the grid is its own neighbor. Around a point that is not finite there are none. Indices and distances
    count as constants on a ``wp.Tape``; compute distances from the points where they should not.

    Args:
        grid: ``grid.on_kernel()``.
        point: The query point [world].
        radius: Search radius [world]; radii near ``grid.radius`` are fastest.
    """
    found = Neighbor()
    if wp.isfinite(point) and radius >= wp.float64(0.0):
        found.point = point
        found.squared = radius * radius
        found.near = nearness_of(grid.cells, point, radius)
        found.box = cells_around(grid.cells, point, reach_of(radius))
        found.rows = row_count(found.box)
    return next_neighbor(grid, found)


@wp.func_grad(next_neighbor)
def adj_next_neighbor(grid: NeighborGrid, last: Neighbor, adj_ret: Neighbor):
    pass


@wp.func_grad(first_neighbor)
def adj_first_neighbor(grid: NeighborGrid, point: wp.vec3d, radius: wp.float64, adj_ret: Neighbor):
    pass
