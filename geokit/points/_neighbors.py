"""Exact neighbor searches on the CPU and on a GPU."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from geokit.core import available_memory, launcher
from geokit.core.user_arrays import Batch, read_vectors, require_finite, require_finite_scalar
from geokit.points.search import radius as search
from geokit.points.search.cells import Cells, build_cells, survey, usual_spacing
from geokit.points.search.hash_grid import build_hash_grid
from geokit.points.search.inputs import require_order, require_radii, require_radius, require_self
from geokit.points.search.nearest import KNearest, build_tree, nearest, require_k

if TYPE_CHECKING:
    import warp as wp

__all__ = ["KNearest", "NeighborBlock", "NeighborGrid", "Neighbors", "Pairs"]

# Cells are reused for query radii that differ from theirs by at most this factor: at worst 6 x 6 rows of cells are
# read, or 8 times the volume of the best cells. Beyond it, the points are sorted again.
RADIUS_RATIO = 2.0
# Default radius in usual spacings: about 33 neighbors in a volume, 12 on a surface.
SPACINGS = 2.0
# If a cell of the radius holds no more points than the first number, averaged over the points, longer cells are tried.
# They are kept if they hold no more than the second: testing their points is then cheaper than looking up more rows of
# shorter cells.
LONELY = 1.5
MOST_CROWDED = 4.0
# Cell length for a radius of 0, as a share of the usual spacing.
LEAST_OF_SPACING = 1e-6
# Crowded cells are shortened by this factor until they are not crowded or are as long as the radius.
SHORTENING = 4.0
# Share of the free memory that one block of neighbors may use.
BLOCK_SHARE = 0.25


class Neighbors(NamedTuple):
    """Neighbors of Q queries as compressed sparse rows (CSR).

    Attributes:
        offsets: Row i is ``[offsets[i], offsets[i + 1])``; shape (Q + 1,) int64.
        indices: Indices of the neighbors among the points of the grid; shape (M,) int32.
        distance: Distances of the neighbors from the query [world]; shape (M,).
    """

    offsets: Any
    indices: Any
    distance: Any


class NeighborBlock(NamedTuple):
    """Neighbors of consecutive queries, starting with query ``first``."""

    first: int
    neighbors: Neighbors


class Pairs(NamedTuple):
    """Pairs of points, each pair once, in ascending order.

    Attributes:
        indices: Indices i < j of the two points; shape (M, 2) int32.
        distance: Distance between the two points [world]; shape (M,).
    """

    indices: Any
    distance: Any


class NeighborGrid:
    """Points prepared for neighbor searches.

    The points are copied as float64 and sorted into cells of about the radius. Memory: 40 to 64 bytes a point, plus up
    to 28 more during sorting, for any extent of the points.

    Results are exact: point j is a neighbor of query i if ``(dx * dx + dy * dy) + dz * dz <= radius * radius`` holds in
    float64, term by term, for the coordinates as given. They are the same on every device, for any number of threads
    and any order of the queries.

    Exactness is tested for radii of 1e-3 to 1e3 spacings, clouds of 1e-6 to 1e15 radii, any crowding, and 1000 points
    in one place.

    Args:
        points: Positions [world], shape (N, 3), float32 or float64, in any supported container.
        radius: Search radius [world] that the cells are made for, and the default radius of searches. None for twice
            the spacing of the points (about 30 neighbors in a volume, 12 on a surface); the cells are then made by the
            first radius search.
        device: Where the points live and queries run: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Raises:
        InputError: points is not (N, 3), not finite, or its extent overflows float64; radius is negative or not a
            finite number; there is no such device.
    Source:
        Green, Particle Simulation using CUDA (2010). Differs: float64 decides where float32 leaves a doubt; x-rows of
        cells are read as one range; a table over leading key bits bounds the memory for any extent.
    Example:
        >>> grid = NeighborGrid([[0, 0, 0], [1, 0, 0], [3, 0, 0]], 1.0, device="cpu")
        >>> grid.count([[0, 0, 0]]).tolist()
        [2]

    Held by: tests/accuracy/stability/test_envelopes.py
    """

    def __init__(self, points: Any, radius: float | None = None, *, device: Any = None) -> None:
        import warp as wp

        wanted = None if radius is None else require_radius(radius)
        self._device = launcher.resolve_device(device)
        batch = read_vectors(points, "points", self._device, defer=True, keep_float32=wanted is not None)
        rows = batch.array
        # Container and device for results about the points themselves; the points are not kept.
        self._home, self._count = Batch(None, batch.is_float32, batch.to_caller), len(rows)
        self._survey = survey(rows, lambda: require_finite(batch, "points"))
        self._spacing = usual_spacing(self._survey, self._count)
        # Points that coincide have no spacing; any radius serves.
        self._radius = (SPACINGS * self._spacing or 1.0) if wanted is None else wanted
        # Each entry is a set of cells with the least radius that it suits: the cells of the grid's radius, and the
        # cells of the last query radius that needed its own. Without a radius the points stay unsorted until the first
        # radius search.
        self._own: tuple[Cells, float] | None = None
        self._other: tuple[Cells, float] | None = None
        self._rows: Any = None
        if wanted is None:
            self._rows = wp.clone(rows)
        else:
            self._own = self._built(rows, self._radius)
        self._tree: Any = None
        self._hash_grid: Any = None

    @property
    def radius(self) -> float:
        """Default search radius [world]."""
        return self._radius

    @property
    def device(self) -> str:
        """Alias of the device that holds the points."""
        return self._device.alias

    @property
    def id(self) -> int:
        """Id of a ``wp.HashGrid`` over the points, for ``wp.hash_grid_query`` in user kernels.

        The hash grid is built on first access (16 MiB plus 20 bytes a point), with cells of ``radius``. It holds the
        points in world coordinates as float32, in their original order, and lives as long as this object. Warp's
        queries return candidates from whole cells; the kernel must compare the distances itself.
        """
        if self._hash_grid is None:
            # Warp needs a positive cell length even if the radius is 0.
            self._hash_grid = build_hash_grid(self._points(), self._radius or self._spacing or 1.0)
        return int(self._hash_grid[0].id)

    def __len__(self) -> int:
        return self._count

    def __repr__(self) -> str:
        return f"NeighborGrid({self._count} points, radius={self._radius:g}, device={self.device!r})"

    def count(self, queries: Any = None, *, radius: Any = None, exclude_self: bool = False) -> Any:
        """Count the points within the radius of each query.

        Args:
            queries: Positions [world], shape (Q, 3), float32 or float64; None for the points themselves, which is
                faster than passing them again.
            radius: Search radius [world], or one for each query, shape (Q,); None for the radius of the grid. A radius
                more than twice as long or less than half as long sorts the points again; the last such radius is
                cached.
            exclude_self: Query i stands for point i, at any position, and does not count it. Only that index is left
                out, not other points at the same position.
        Returns:
            Counts (Q,) int32, in the container of the queries.
        Raises:
            InputError: queries is not (Q, 3) or not finite; a radius is negative or not a finite number, or radius has
                neither one nor Q entries; exclude_self is given and the number of queries is not the number of points.
        """
        asked, home = self._ask(queries, radius, exclude_self)
        return home.to_caller(search.count(asked))

    def radius_search(
        self, queries: Any = None, *, radius: Any = None, exclude_self: bool = False, order: str = "index"
    ) -> Neighbors:
        """Find the points within the radius of each query, with their distances.

        ``distance`` is the rounded square root of the squared distance that was compared.

        Args:
            queries: Positions [world], shape (Q, 3), float32 or float64; None for the points themselves.
            radius: Search radius [world], or one for each query, shape (Q,); None for the radius of the grid.
            exclude_self: Query i stands for point i and does not find it; other points at the same position are found.
            order: Order within a row. "index": ascending index. "distance": ascending float64 distance, then index.
                "any": the order of the cells, which is fastest and the same on every device, but depends on the radius
                and on the set of points.
        Returns:
            Neighbors with offsets (Q + 1,) int64, indices (M,) int32 and distance (M,) [world], in the container of
            the queries; distance is float32 for float32 queries.
        Raises:
            InputError: queries is not (Q, 3) or not finite; a radius is negative or not a finite number, or radius has
                neither one nor Q entries; exclude_self is given and the number of queries is not the number of points;
                order is not known.
            DeviceMemoryError: The neighbors do not fit in memory, or number more than 2^31 - 1 in all; nothing has been
                allocated for them. :meth:`radius_search_blocks` returns them block by block.
        """
        require_order(order)
        asked, home = self._ask(queries, radius, exclude_self)
        return Neighbors(
            *map(home.to_caller, self._filled(asked, search.count(asked, note=True), order, home.is_float32))
        )

    def radius_search_blocks(
        self,
        queries: Any = None,
        *,
        radius: Any = None,
        exclude_self: bool = False,
        order: str = "index",
        memory: int | None = None,
    ) -> Iterator[NeighborBlock]:
        """Find the points within the radius of each query, one block of queries at a time.

        The rows are those of :meth:`radius_search`, but the neighbors of all queries need not fit in memory at once.
        All arguments are checked and all neighbors counted before the first block; each block is computed on demand.

        Args:
            queries: Positions [world], shape (Q, 3), float32 or float64; None for the points themselves.
            radius: Search radius [world], or one for each query, shape (Q,); None for the radius of the grid.
            exclude_self: Query i stands for point i and does not find it; other points at the same position are found.
            order: Order within a row: "index", "distance" (then index) or "any" (that of the cells, the fastest).
            memory: Most bytes for the neighbors of a block, 12 bytes each; None for a quarter of the free memory. A
                single query that needs more is a block of its own.
        Returns:
            Iterator over NeighborBlock(first, neighbors) for consecutive queries: row i of ``neighbors`` belongs to
            query ``first + i``. ``neighbors`` has offsets (B + 1,) int64 for the B queries of the block, indices (M,)
            int32 and distance (M,) [world], float32 for float32 queries, in the container of the queries.
        Raises:
            InputError: queries is not (Q, 3) or not finite; a radius is negative or not a finite number, or radius has
                neither one nor Q entries; exclude_self is given and the number of queries is not the number of points;
                order is not known; memory is not a positive number.
            DeviceMemoryError: The neighbors of one query do not fit in memory.
        Example:
            >>> grid = NeighborGrid([[0, 0, 0], [1, 0, 0], [3, 0, 0]], 1.0, device="cpu")
            >>> [(first, found.indices.tolist()) for first, found in grid.radius_search_blocks(memory=24)]
            [(0, [0, 1]), (1, [0, 1]), (2, [2])]
        """
        require_order(order)
        if memory is not None:
            require_finite_scalar(memory, "memory", low=0.0)
        budget = int(BLOCK_SHARE * available_memory.available(self._device)) if memory is None else int(memory)
        batch = self._own_batch() if queries is None else read_vectors(queries, "queries", self._device)
        radii = self._radii(radius, len(batch))
        require_self(exclude_self, len(batch), self._count)
        counts = search.count(self._asked(batch.array, len(batch), radii, exclude_self)).numpy()
        return self._blocks(batch, radii, exclude_self, order, counts, budget)

    def pairs(self, *, radius: float | None = None) -> Pairs:
        """Find all pairs of points within the radius of each other, each pair once.

        Args:
            radius: Search radius [world]; None for the radius of the grid.
        Returns:
            Pairs with indices (M, 2) int32, i < j, ascending, and distance (M,) [world], in the container of the
            points.
        Raises:
            InputError: radius is negative or not a finite number.
            DeviceMemoryError: The neighbors of all points, found first, do not fit in memory or number more than 2^31 -
                1.
        """
        import warp as wp

        from geokit.points.search import radius_cuda_kernels as kernels

        asked, home = self._ask(None, None if radius is None else require_radius(radius), False)
        offsets, indices, distance = self._filled(asked, search.count(asked, note=True), "index", single=False)
        counts = wp.empty(self._count, dtype=wp.int32, device=self._device)
        launcher.launch(kernels.pair_count_kernel, self._count, [offsets, indices], [counts], self._device)
        starts = search.offsets_of(counts)
        total = int(starts[self._count :].numpy()[0])
        pairs = wp.empty((total, 2), dtype=wp.int32, device=self._device)
        lengths = wp.empty(total, dtype=wp.float64, device=self._device)
        given = [offsets, indices, distance, starts]
        launcher.launch(kernels.pair_fill_kernel, self._count, given, [pairs, lengths], self._device)
        return Pairs(home.to_caller(pairs), home.to_caller(lengths))

    def knn(self, queries: Any = None, k: int = 1, *, exclude_self: bool = False) -> KNearest:
        """Find the k nearest points of each query at any distance.

        Exact: the k smallest values of ``(dx * dx + dy * dy) + dz * dz`` in float64, each operation rounded once; ties
        go to the lower index. The result is the same on every device. The first call builds a tree over the points
        (about 60 bytes a point), which is kept.

        Args:
            queries: Positions [world], shape (Q, 3), float32 or float64; None for the points themselves.
            k: Number of neighbors, 1 to 1024.
            exclude_self: Query i stands for point i and does not find it; other points at the same position are found.
        Returns:
            KNearest with distance (Q, k) [world], the nearest first, and indices (Q, k) int32, in the container of the
            queries; inf and -1 fill rows with fewer than k points. distance is float32 for float32 queries.
        Raises:
            InputError: queries is not (Q, 3) or not finite; k is not a whole number from 1 to 1024; exclude_self is
                given and the number of queries is not the number of points.
            DeviceMemoryError: The results do not fit in memory.
        Example:
            >>> grid = NeighborGrid([[0, 0, 0], [1, 0, 0], [3, 0, 0]], device="cpu")
            >>> grid.knn([[2.5, 0, 0]], k=2).indices.tolist()
            [[2, 1]]

        Held by: tests/points/search/test_nearest_property.py
        """
        return self._nearest(queries, k, np.inf, exclude_self)

    def hybrid(self, queries: Any = None, k: int = 1, *, radius: Any = None, exclude_self: bool = False) -> KNearest:
        """Find the k nearest points within the radius of each query.

        Exact: among the points with ``(dx * dx + dy * dy) + dz * dz <= radius * radius`` in float64, each operation
        rounded once, those with the k smallest values of the left side; ties go to the lower index. A point at exactly
        the radius counts.

        Args:
            queries: Positions [world], shape (Q, 3), float32 or float64; None for the points themselves.
            k: Number of neighbors, 1 to 1024.
            radius: Search radius [world], or one for each query, shape (Q,); None for the radius of the grid.
            exclude_self: Query i stands for point i and does not find it; other points at the same position are found.
        Returns:
            KNearest with distance (Q, k) [world], the nearest first, and indices (Q, k) int32, in the container of the
            queries; inf and -1 fill rows with fewer than k points within the radius. distance is float32 for float32
            queries.
        Raises:
            InputError: queries is not (Q, 3) or not finite; k is not a whole number from 1 to 1024; a radius is
                negative or not a finite number, or radius has neither one nor Q entries; exclude_self is given and the
                number of queries is not the number of points.
            DeviceMemoryError: The results do not fit in memory.
        """
        return self._nearest(queries, k, radius, exclude_self)

    def _nearest(self, queries: Any, k: int, radius: Any, exclude_self: bool) -> KNearest:
        import warp as wp

        k = require_k(k)
        batch = None if queries is None else read_vectors(queries, "queries", self._device)
        count = self._count if batch is None else len(batch)
        limit = radius if np.ndim(radius) == 0 and radius == np.inf else self._radii(radius, count)
        require_self(exclude_self, count, self._count)
        if self._tree is None:
            self._tree = build_tree(self._points())
        with np.errstate(over="ignore"):
            squared = np.square(limit)
        if np.ndim(squared):
            squared = wp.array(squared, dtype=wp.float64, device=self._device)
        rows, give = (None, self._home.to_caller) if batch is None else (batch.array, batch.to_caller)
        found = nearest(self._tree, k, rows, limit_squared=squared, exclude_self=exclude_self)
        return KNearest(*map(give, found))

    def _ask(self, queries: Any, radius: Any, exclude_self: bool) -> tuple[search.Asked, Batch]:
        """The checked queries with their radii, and the batch that returns results in their container."""
        if queries is None:
            radii = self._radii(radius, self._count)
            return self._asked(None, self._count, radii, exclude_self), self._home
        batch = read_vectors(queries, "queries", self._device, keep_float32=self._device.is_cuda)
        radii = self._radii(radius, len(batch))
        require_self(exclude_self, len(batch), self._count)
        return self._asked(batch.array, len(batch), radii, exclude_self), batch

    def _asked(self, rows: Any, count: int, radii: Any, exclude_self: bool, first_point: int = 0) -> search.Asked:
        return search.Asked(
            rows, count, radii, self._cells_for, self._device, own=exclude_self, first_point=first_point
        )

    def _filled(self, asked: search.Asked, counts: "wp.array", order: str, single: bool) -> tuple[Any, Any, Any]:
        def refuse(total: int) -> None:
            search.require_room(total, asked.count, self._device)

        if order == "distance":
            # Rows are sorted by float64 distances, so the order in which they are filled does not matter.
            found = search.fill(asked, counts, refuse, order="any")
            search.sort_by_distance(*found)
            return found
        return search.fill(asked, counts, refuse, order=order, single=single)

    def _blocks(
        self, batch: Batch, radii: Any, exclude_self: bool, order: str, counts: np.ndarray, budget: int
    ) -> Iterator[NeighborBlock]:
        import warp as wp

        for begin, end in search.blocks_of(counts, budget):
            part = radii if np.ndim(radii) == 0 else radii[begin:end]
            asked = self._asked(batch.array[begin:end].contiguous(), end - begin, part, exclude_self, begin)
            known = wp.array(counts[begin:end], dtype=wp.int32, device=self._device)
            yield NeighborBlock(
                begin, Neighbors(*map(batch.to_caller, self._filled(asked, known, order, batch.is_float32)))
            )

    def _own_batch(self) -> Batch:
        return Batch(self._points(), self._home.is_float32, self._home.to_caller)

    def _radii(self, radius: Any, count: int) -> Any:
        """One radius, or an array with one for each query."""
        if radius is None:
            return self._radius
        if np.ndim(radius) == 0 and not hasattr(radius, "__len__"):
            return require_radius(radius)
        return require_radii(radius, count)

    def _cells_for(self, radius: float) -> Cells:
        for cells, least in filter(None, (self._sorted(), self._other)):
            if least <= radius <= RADIUS_RATIO * cells.radius:
                return cells
        # Release the old cells first: both may not fit in memory at once.
        self._other = None
        self._other = self._built(self._points(), radius)
        return self._other[0]

    def _sorted(self) -> tuple[Cells, float]:
        """The cells for the grid's own radius."""
        if self._own is None:
            self._own = self._built(self._rows, self._radius)
            self._rows = None
        return self._own

    @property
    def _cells(self) -> Cells:
        return self._sorted()[0]

    def _points(self) -> "wp.array":
        """The points as vec3d in their original order."""
        return search.points_of(self._cells.grid) if self._rows is None else self._rows

    def _built(self, rows: "wp.array", radius: float) -> tuple[Cells, float]:
        """Cells that suit a radius, and the least radius that they suit.

        If few points lie within the radius of each other, longer cells are faster: there are fewer cells to look up.
        """
        edge = radius or LEAST_OF_SPACING * self._spacing or 1.0
        cells = build_cells(rows, self._survey, edge)
        if edge >= self._spacing or search.crowding(cells) > LONELY:
            return cells, radius / RADIUS_RATIO
        longer = self._spacing
        while longer > edge:
            other = build_cells(rows, self._survey, longer)
            if search.crowding(other) <= MOST_CROWDED:
                return other, 0.0
            longer /= SHORTENING
        return cells, radius / RADIUS_RATIO
