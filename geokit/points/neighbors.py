"""Neighbours within a radius, exactly, on the CPU and on a GPU."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from geokit import _launch, _memory
from geokit._arrays import Batch, read_vectors, require_finite_scalar
from geokit.errors import DeviceMemoryError
from geokit.points._cells import Cells, build_cells, crowd_box, points_box

if TYPE_CHECKING:
    import warp as wp

__all__ = ["NeighborGrid", "Neighbors"]

# A neighbour's coordinate may differ from the query's by slightly more than the radius and its rounded squared distance
# still not exceed the rounded squared radius: each of these roundings is at most 1.2e-16 relative.
REACH_RELATIVE = 1e-15
# Squares below 4.9e-324 round to 0: coordinates up to 2.3e-162 apart count as equal for every radius.
REACH_ABSOLUTE = 1e-161
# Cells up to this much longer or shorter than the query radius are used as they are: at worst 6 x 6 rows of cells are
# read, or 8 times the volume of the best cells. Beyond, the points are sorted again.
RADIUS_RATIO = 2.0
# int32 index and float64 distance.
BYTES_PER_NEIGHBOR = 12
# One flat array holds the neighbours of all queries, and its positions are int32.
MAX_NEIGHBORS = 2**31 - 1
# Cells on an axis of the hash grid for the user's own kernels: 128^3 takes 16 MiB and is warp's usual size.
HASH_GRID_SIZE = 128


class Neighbors(NamedTuple):
    """Neighbours of Q queries, row after row (CSR).

    Attributes:
        offsets: Row i is ``[offsets[i], offsets[i + 1])``; shape (Q + 1,) int64.
        indices: Indices of the neighbours among the grid's points, ascending in each row; shape (M,) int32.
        distance: Their distances from the query [world]; shape (M,).
    """

    offsets: Any
    indices: Any
    distance: Any


class NeighborGrid:
    """Points prepared for radius searches.

    The points are copied in float64 and sorted by cells of about the radius. Memory: 28 to 52 bytes a point, and up to
    28 more while they are sorted, whatever the extent of the points.

    Answers are exact: point j is a neighbour of query i where ``(dx * dx + dy * dy) + dz * dz <= radius * radius``
    holds in float64, term by term, on the coordinates as they were given.

    Args:
        points: Positions [world], shape (N, 3), float32 or float64, in any supported container.
        radius: The search radius [world] that the cells are made for.
        device: Where the points live and queries run: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Raises:
        InputError: points is not (N, 3), not finite, or spreads over more than a float64 holds; radius is not a
            positive finite number; there is no such device.
    Source:
        Green, Particle Simulation using CUDA (2010). Differs: exact float64 comparisons; x-rows of cells are read as
        one range; a table over leading key bits bounds the memory for any extent.
    Example:
        >>> grid = NeighborGrid([[0, 0, 0], [1, 0, 0], [3, 0, 0]], 1.0, device="cpu")
        >>> grid.count([[0, 0, 0]]).tolist()
        [2]
    """

    def __init__(self, points: Any, radius: float, *, device: Any = None) -> None:
        self._radius = _require_radius(radius)
        self._device = _launch.resolve_device(device)
        rows = read_vectors(points, "points", self._device).array
        self._count = len(rows)
        self._lower, self._upper = points_box(rows)
        # Where most of the points are: this is what the order of queries resolves.
        self._order_lower, self._order_extent = crowd_box(rows)
        self._cells = build_cells(rows, self._lower, self._upper, self._radius)
        # Cells for the last query radius that the first ones did not suit.
        self._other_cells: Cells | None = None
        self._hash_grid: Any = None

    @property
    def radius(self) -> float:
        """The radius [world] that searches use unless told otherwise."""
        return self._radius

    @property
    def device(self) -> str:
        """Alias of the device that holds the points."""
        return self._device.alias

    @property
    def id(self) -> int:
        """Id of a ``wp.HashGrid`` over the points, for ``wp.hash_grid_query`` in the user's own kernels.

        It is built when first asked for (16 MiB and 20 bytes a point), with cells of ``radius``, over the points in
        world coordinates as float32, in the order in which they were given; it lives as long as this object. Warp's
        queries visit candidates in whole cells: the kernel compares the distances itself.
        """
        if self._hash_grid is None:
            self._hash_grid = self._build_hash_grid()
        return int(self._hash_grid[0].id)

    def __len__(self) -> int:
        return self._count

    def __repr__(self) -> str:
        return f"NeighborGrid({self._count} points, radius={self._radius:g}, device={self.device!r})"

    def count(self, queries: Any, *, radius: float | None = None) -> Any:
        """Number of points within the radius of each query; a query that is one of the points counts itself.

        Exact for the float64 coordinates; the same for every device, number of threads and order of the queries.

        Args:
            queries: Positions [world], shape (Q, 3), float32 or float64.
            radius: Search radius [world]; None for the grid's own. One more than twice as long or less than half as
                long sorts the points again for it; the last such radius is remembered.
        Returns:
            Counts (Q,) int32, in the container of the queries.
        Raises:
            InputError: queries is not (Q, 3) or not finite; radius is not a positive finite number.
        """
        radius = self._radius if radius is None else _require_radius(radius)
        batch = read_vectors(queries, "queries", self._device)
        return batch.give(self._counts(batch, radius))

    def radius_search(self, queries: Any, *, radius: float | None = None) -> Neighbors:
        """Points within the radius of each query, with their distances.

        Exact for the float64 coordinates; the same for every device, number of threads and order of the queries. Rows
        list their neighbours by ascending index; a query that is one of the points finds itself. ``distance`` is the
        rounded square root of the squared distance that was compared.

        Args:
            queries: Positions [world], shape (Q, 3), float32 or float64.
            radius: Search radius [world]; None for the grid's own. One more than twice as long or less than half as
                long sorts the points again for it; the last such radius is remembered.
        Returns:
            Neighbors with offsets (Q + 1,) int64, indices (M,) int32 and distance (M,) [world], in the container of
            the queries; distance is float32 for float32 queries.
        Raises:
            InputError: queries is not (Q, 3) or not finite; radius is not a positive finite number.
            DeviceMemoryError: The neighbours would not fit in memory, or are more than 2^31 - 1 in all; nothing has
                been allocated for them.
        """
        import warp as wp

        from geokit.points._neighbors_kernels import fill_kernel

        radius = self._radius if radius is None else _require_radius(radius)
        batch = read_vectors(queries, "queries", self._device)
        offsets = self._offsets(self._counts(batch, radius))
        total = int(offsets[len(batch) :].numpy()[0])
        self._require_room(total, len(batch), radius)
        indices = wp.empty(total, dtype=wp.int32, device=self._device)
        distance = wp.empty(total, dtype=wp.float64, device=self._device)
        shared = [*self._search(radius), indices, distance]
        self._launch(fill_kernel, batch, shared, outputs=(), streams=(offsets,))
        return Neighbors(batch.give(offsets), batch.give(indices), batch.give(distance))

    def _counts(self, batch: Batch, radius: float) -> "wp.array":
        import warp as wp

        from geokit.points._neighbors_kernels import count_kernel

        counts = wp.empty(len(batch), dtype=wp.int32, device=self._device)
        self._launch(count_kernel, batch, self._search(radius), outputs=(counts,))
        return counts

    def _offsets(self, counts: "wp.array") -> "wp.array":
        import warp as wp

        from geokit.points._neighbors_kernels import offset_kernel

        wide = wp.empty(len(counts), dtype=wp.int64, device=self._device)
        offsets = wp.zeros(len(counts) + 1, dtype=wp.int64, device=self._device)
        if len(counts):
            _launch.launch(offset_kernel, len(counts), [counts], [wide], self._device)
            wp.utils.array_scan(wide, offsets[1:], inclusive=True)
        return offsets

    def _launch(
        self, kernel: Any, batch: Batch, shared: list[Any], *, outputs: tuple[Any, ...], streams: tuple[Any, ...] = ()
    ) -> None:
        _launch.launch_queries(
            kernel,
            batch.array,
            shared,
            outputs,
            self._device,
            lower=self._order_lower,
            extent=self._order_extent,
            streams=streams,
        )

    def _search(self, radius: float) -> list[Any]:
        """What every query of a search with this radius shares: the cells, their reach and the squared radius."""
        import warp as wp

        reach = radius * (1.0 + REACH_RELATIVE) + REACH_ABSOLUTE
        return [self._cells_for(radius).grid, wp.float64(reach), wp.float64(radius * radius)]

    def _cells_for(self, radius: float) -> Cells:
        for cells in (self._cells, self._other_cells):
            if cells is not None and 1.0 / RADIUS_RATIO <= radius / cells.radius <= RADIUS_RATIO:
                return cells
        # Let go of the old ones first: both need not fit at once.
        self._other_cells = None
        cells = build_cells(self._points(), self._lower, self._upper, radius)
        self._other_cells = cells
        return cells

    def _points(self) -> "wp.array":
        import warp as wp

        from geokit.points._cells_kernels import unsort_kernel

        points = wp.empty(self._count, dtype=wp.vec3d, device=self._device)
        _launch.launch(unsort_kernel, self._count, [self._cells.grid], [points], self._device)
        return points

    def _require_room(self, total: int, query_count: int, radius: float) -> None:
        what = f"radius_search: {query_count} queries have {total} neighbours within {radius:g}"
        remedy = "use a smaller radius, fewer queries at a time, or count()"
        needed, free = total * BYTES_PER_NEIGHBOR, _memory.available(self._device)
        if needed > free:
            raise DeviceMemoryError(
                f"{what}, which need {needed / 2**30:.3g} GiB of {free / 2**30:.3g} GiB free on {self.device}; {remedy}"
            )
        if total > MAX_NEIGHBORS:
            raise DeviceMemoryError(f"{what}; one result holds at most {MAX_NEIGHBORS}: {remedy}")

    def _build_hash_grid(self) -> tuple[Any, Any]:
        import warp as wp

        from geokit.points._cells_kernels import unsort_single_kernel

        points = wp.empty(self._count, dtype=wp.vec3f, device=self._device)
        _launch.launch(unsort_single_kernel, self._count, [self._cells.grid], [points], self._device)
        grid = wp.HashGrid(HASH_GRID_SIZE, HASH_GRID_SIZE, HASH_GRID_SIZE, device=self._device)
        grid.build(points, self._radius)
        # Warp's grid may keep the address of the points, but not the array.
        return grid, points


def _require_radius(radius: Any) -> float:
    return require_finite_scalar(radius, "radius", low=0.0)
