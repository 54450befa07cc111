"""Neighbours of points, exactly, on the CPU and on a GPU."""

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

# Cells up to this much longer or shorter than the query radius are used as they are: at worst 6 x 6 rows of cells are
# read, or 8 times the volume of the best cells. Beyond, the points are sorted again.
RADIUS_RATIO = 2.0
# The usual spacings that a radius chosen from the data is long: 33 neighbours in a volume, 12 on a surface.
SPACINGS = 2.0
# Where a cell of the radius has no more points than this, averaged over the points, longer cells are tried; they are
# kept where they have no more than the second: reading them takes less than finding the rows of shorter cells would.
LONELY = 1.5
MOST_CROWDED = 4.0
# Cells for a radius of 0 are this part of the usual spacing long.
LEAST_OF_SPACING = 1e-6
# Crowded cells are shortened by this factor until they are not, or are as long as the radius.
SHORTENING = 4.0
# Share of the free memory that a block of neighbours may take.
BLOCK_SHARE = 0.25


class Neighbors(NamedTuple):
    """Neighbours of Q queries, row after row (CSR).

    Attributes:
        offsets: Row i is ``[offsets[i], offsets[i + 1])``; shape (Q + 1,) int64.
        indices: Indices of the neighbours among the grid's points; shape (M,) int32.
        distance: Their distances from the query [world]; shape (M,).
    """

    offsets: Any
    indices: Any
    distance: Any


class NeighborBlock(NamedTuple):
    """Neighbours of the queries from ``first`` on."""

    first: int
    neighbors: Neighbors


class Pairs(NamedTuple):
    """Pairs of points, each once, ascending.

    Attributes:
        indices: Indices i < j of the two points; shape (M, 2) int32.
        distance: How far they are from each other [world]; shape (M,).
    """

    indices: Any
    distance: Any


class NeighborGrid:
    """Points prepared for neighbour searches.

    The points are copied in float64 and sorted by cells of about the radius. Memory: 40 to 64 bytes a point, and up to
    28 more while they are sorted, whatever the extent of the points.

    Answers are exact: point j is a neighbour of query i where ``(dx * dx + dy * dy) + dz * dz <= radius * radius``
    holds in float64, term by term, on the coordinates as they were given. They are the same on every device, for every
    number of threads and order of the queries.

    Exact for radii of 1e-3 to 1e3 spacings, clouds of 1e-6 to 1e15 radii, any crowding, and 1000 points in one place.
    Held by tests/accuracy/stability/test_envelopes.py.

    Args:
        points: Positions [world], shape (N, 3), float32 or float64, in any supported container.
        radius: The search radius [world] that the cells are made for and that searches use unless told otherwise;
            None for twice the spacing of the points (about 30 neighbours in a volume, 12 on a surface), in cells that
            are made when a radius search first asks for them.
        device: Where the points live and queries run: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Raises:
        InputError: points is not (N, 3), not finite, or spreads over more than a float64 holds; radius is negative or
            not a finite number; there is no such device.
    Source:
        Green, Particle Simulation using CUDA (2010). Differs: float64 decides, where float32 leaves a doubt; x-rows of
        cells are read as one range; a table over leading key bits bounds the memory for any extent.
    Example:
        >>> grid = NeighborGrid([[0, 0, 0], [1, 0, 0], [3, 0, 0]], 1.0, device="cpu")
        >>> grid.count([[0, 0, 0]]).tolist()
        [2]
    """

    def __init__(self, points: Any, radius: float | None = None, *, device: Any = None) -> None:
        import warp as wp

        wanted = None if radius is None else require_radius(radius)
        self._device = launcher.resolve_device(device)
        batch = read_vectors(points, "points", self._device, defer=True, keep_float32=wanted is not None)
        rows = batch.array
        # How answers about the points themselves go back; the rows are not kept.
        self._home, self._count = Batch(None, batch.is_float32, batch.to_caller), len(rows)
        self._survey = survey(rows, lambda: require_finite(batch, "points"))
        self._spacing = usual_spacing(self._survey, self._count)
        # Points that all lie in one place have no spacing: any radius is as good.
        self._radius = (SPACINGS * self._spacing or 1.0) if wanted is None else wanted
        # Cells with the least radius that they suit: those for the grid's radius, and those for the last query radius
        # that these did not suit. Without a radius the points are kept as they are until a radius search sorts them.
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
            # Warp wants cells of some length also where the radius is 0.
            self._hash_grid = build_hash_grid(self._points(), self._radius or self._spacing or 1.0)
        return int(self._hash_grid[0].id)

    def __len__(self) -> int:
        return self._count

    def __repr__(self) -> str:
        return f"NeighborGrid({self._count} points, radius={self._radius:g}, device={self.device!r})"

    def count(self, queries: Any = None, *, radius: Any = None, exclude_self: bool = False) -> Any:
        """Number of points within the radius of each query.

        Args:
            queries: Positions [world], shape (Q, 3), float32 or float64; None for the points themselves, which is
                quicker than to hand them in again.
            radius: Search radius [world], or one for each query, shape (Q,); None for the grid's own. One more than
                twice as long or less than half as long sorts the points again for it; the last such radius is
                remembered.
            exclude_self: Query i stands for point i, wherever it is, and does not count it; only that index is left
                out, not other points in the same place.
        Returns:
            Counts (Q,) int32, in the container of the queries.
        Raises:
            InputError: queries is not (Q, 3) or not finite; a radius is negative or not a finite number, or there are
                other than one or Q; exclude_self with queries that are not as many as the points.
        """
        asked, home = self._ask(queries, radius, exclude_self)
        return home.to_caller(search.count(asked))

    def radius_search(
        self, queries: Any = None, *, radius: Any = None, exclude_self: bool = False, order: str = "index"
    ) -> Neighbors:
        """Points within the radius of each query, with their distances.

        ``distance`` is the rounded square root of the squared distance that was compared.

        Args:
            queries: As for :meth:`count`.
            radius: As for :meth:`count`.
            exclude_self: As for :meth:`count`.
            order: "index" lists each row by ascending index, "distance" by ascending float64 distance, then index;
                "any" leaves it in the order of the cells, which is the quickest, and the same on every device, but
                another for another radius or set of points.
        Returns:
            Neighbors with offsets (Q + 1,) int64, indices (M,) int32 and distance (M,) [world], in the container of
            the queries; distance is float32 for float32 queries.
        Raises:
            InputError: As for :meth:`count`; order is neither.
            DeviceMemoryError: The neighbours would not fit in memory, or are more than 2^31 - 1 in all; nothing has
                been allocated for them. :meth:`radius_search_blocks` gives them one block after the other.
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
        """As :meth:`radius_search`, block after block: the neighbours of all queries need not fit in memory at once.

        Everything is counted and checked before the first block; blocks are made as they are asked for.

        Args:
            queries: As for :meth:`count`.
            radius: As for :meth:`count`.
            exclude_self: As for :meth:`radius_search`.
            order: As for :meth:`radius_search`.
            memory: Bytes that a block's neighbours may take, 12 each; None for a quarter of what is free. A single
                query with more is a block of its own.
        Returns:
            NeighborBlock(first, neighbors) for consecutive queries: row i of ``neighbors`` is that of query
            ``first + i``.
        Raises:
            InputError: As for :meth:`radius_search`; memory is not a positive number.
            DeviceMemoryError: One query has more neighbours than fit.
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
        """Pairs of points that are within the radius of each other, each once.

        Args:
            radius: Search radius [world]; None for the grid's own.
        Returns:
            Pairs with indices (M, 2) int32, i < j, ascending, and distance (M,) [world], in the container of the
            points.
        Raises:
            InputError: radius is negative or not a finite number.
            DeviceMemoryError: As for :meth:`radius_search`, which this asks about all points.
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
        """The k nearest points of each query, however far.

        Exact: the k smallest of ``(dx * dx + dy * dy) + dz * dz`` in float64, each operation rounded once; of equally
        near points those with lower indices. The same on every device; held by
        tests/points/search/test_nearest_property.py. A tree over the points is made when first asked for (about 60
        bytes a point) and kept.

        Args:
            queries: Positions [world], shape (Q, 3), float32 or float64; None for the points themselves.
            k: Number of neighbours, 1 to 1024.
            exclude_self: Query i is point i and is not among its own neighbours; other points in the same place are.
        Returns:
            KNearest with distance (Q, k) [world], the nearest first, and indices (Q, k) int32, in the container of the
            queries; inf and -1 where there are fewer points. distance is float32 for float32 queries.
        Raises:
            InputError: queries is not (Q, 3) or not finite; k is not a whole number from 1 to 1024; exclude_self with
                queries that are not as many as the points.
            DeviceMemoryError: The answers would not fit in memory.
        Example:
            >>> grid = NeighborGrid([[0, 0, 0], [1, 0, 0], [3, 0, 0]], device="cpu")
            >>> grid.knn([[2.5, 0, 0]], k=2).indices.tolist()
            [[2, 1]]
        """
        return self._nearest(queries, k, np.inf, exclude_self)

    def hybrid(self, queries: Any = None, k: int = 1, *, radius: Any = None, exclude_self: bool = False) -> KNearest:
        """The k nearest of the points within the radius of each query.

        Exact as :meth:`knn` is, and the radius as that of :meth:`radius_search`: a point at exactly the radius counts.

        Args:
            queries: As for :meth:`knn`.
            k: As for :meth:`knn`.
            radius: Search radius [world], or one for each query, shape (Q,); None for the grid's own.
            exclude_self: As for :meth:`knn`.
        Returns:
            As :meth:`knn`; inf and -1 where there are fewer points within the radius.
        Raises:
            InputError: As for :meth:`knn`; a radius is negative or not a finite number, or there are other than one or
                Q.
            DeviceMemoryError: As for :meth:`knn`.
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
        """The queries with their radii, checked, and the batch that gives results back in their container."""
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
            # Sorted by that of float64; which order they come in does not matter.
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
        """One radius, or an array of one for each query."""
        if radius is None:
            return self._radius
        if np.ndim(radius) == 0 and not hasattr(radius, "__len__"):
            return require_radius(radius)
        return require_radii(radius, count)

    def _cells_for(self, radius: float) -> Cells:
        for cells, least in filter(None, (self._sorted(), self._other)):
            if least <= radius <= RADIUS_RATIO * cells.radius:
                return cells
        # Let go of the old ones first: both need not fit at once.
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
        """The points as vec3d in the order in which they came."""
        return search.points_of(self._cells.grid) if self._rows is None else self._rows

    def _built(self, rows: "wp.array", radius: float) -> tuple[Cells, float]:
        """Cells that suit a radius, and the least radius that they suit.

        Where few points are within the radius of each other longer cells are better: there are fewer to look up.
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
