"""Exact neighbor searches on the CPU and on a GPU."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.forks import Lock
from geokit.core.base.object_cache import CacheAttribute
from geokit.core.blocks.several_devices import OnDevices, replicas, shows_arguments
from geokit.core.gradients.rules import hold, split
from geokit.core.interop.arrays import reinterpreted
from geokit.core.interop.types import Array, Devices, Rows
from geokit.core.interop.user_arrays import (
    FROM_ZERO,
    LARGEST_MEASURED,
    Batch,
    narrowed,
    read_numbers,
    read_vectors,
    require_finite,
    require_finite_scalar,
)
from geokit.core.launches import captured, prepared
from geokit.core.memory import available_memory
from geokit.core.memory.needs import needs, rows
from geokit.core.memory.struct_array import handed_out
from geokit.core.memory.unchecked import allocating
from geokit.core.query.ask import query
from geokit.core.require import require_choice, require_count, require_flag
from geokit.core.scan import row_offsets
from geokit.errors import DeviceMemoryError, InputError
from geokit.points.search import radius as search
from geokit.points.search.cells import Cells, build_cells, survey, usual_spacing
from geokit.points.search.groups import build_group_cells, numbers_of, read_offsets, survey_groups, usual_spacing_of
from geokit.points.search.nearest import KNearest, build_tree, nearest, require_k
from geokit.points.search.periodic import MOST_TURNS, Images, read_cell, sort_by_distance
from geokit.points.search.verlet import VerletLists

if TYPE_CHECKING:
    import warp as wp

    from geokit.points.neighbors.user_kernels import NeighborGrid as InKernels

__all__ = ["Candidates", "KNearest", "NeighborBlock", "NeighborGrid", "NeighborList", "Neighbors", "Pairs"]

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
# Fewest queries for each of several GPUs: neighbors of fewer are found in less time than it takes to copy them.
LEAST_QUERIES_ON_GPUS = 1 << 24
LEAST_COUNTED_ON_GPUS = 40_000_000
# Cells of warp's hash grid on an axis: 128^3 cells take 16 MiB, a common size for warp.
HASH_CELLS = 128


class Neighbors(NamedTuple):
    """Neighbors of Q queries as compressed sparse rows (CSR).

    Attributes:
        offsets: Row i is ``[offsets[i], offsets[i + 1])``; shape (Q + 1,) int64.
        indices: Indices of the neighbors among the points of the grid; shape (M,) int32.
        distance: Distances of the neighbors from the query [world]; shape (M,).
    """

    offsets: Array
    indices: Array
    distance: Array


class NeighborList(NamedTuple):
    """Neighbors of Q queries in a periodic cell, as compressed sparse rows (CSR).

    Attributes:
        offsets: Row i is ``[offsets[i], offsets[i + 1])``; shape (Q + 1,) int64.
        indices: Indices of the points; shape (M,) int32.
        distance: Distances of their images from the query [world]; shape (M,).
        shifts: The image of point j for query i is ``points[j] + shifts @ cell``, seen from where the query was given;
            shape (M, 3) int32.
    """

    offsets: Array
    indices: Array
    distance: Array
    shifts: Array


class Candidates(NamedTuple):
    """Points that may be neighbors of each of N points, as compressed sparse rows (CSR).

    Attributes:
        offsets: Row i is ``[offsets[i], offsets[i + 1])``; shape (N + 1,) int64.
        indices: Indices of the points, ascending in each row; shape (M,) int32.
        shifts: In a periodic cell candidate j of point i is ``points[j] + shifts @ cell``; shape (M, 3) int32. None for
            a grid that is not periodic.
    """

    offsets: Array
    indices: Array
    shifts: Array | None


class NeighborBlock(NamedTuple):
    """Neighbors of consecutive queries.

    Attributes:
        first: The first of these queries.
        neighbors: Their neighbors.
    """

    first: int
    neighbors: Neighbors


class Pairs(NamedTuple):
    """Pairs of points, each pair once, in ascending order.

    Attributes:
        indices: Indices i < j of the two points; shape (M, 2) int32.
        distance: Distance between the two points [world]; shape (M,).
    """

    indices: Array
    distance: Array


def _mean_count(grid: Any, queries: Any, radius: Any, groups: Any) -> float:
    """Mean number of neighbors, by a thousand of the queries."""
    step = max(1, grid._asked_rows(queries) // 1000)
    try:
        some = np.asarray(grid._given().numpy() if queries is None else queries).reshape(-1, 3)[::step]
        if grid._groups is not None:
            groups = -(-np.asarray(grid._groups.offsets if queries is None else groups) // step)
        return float(np.mean(grid.count(some, radius=radius, groups=groups)))
    except (DeviceMemoryError, MemoryError, RuntimeError):  # not even that fits: the least that a list can need
        return 1.0


def _list_bytes(
    self: Any,
    queries: Rows | None = None,
    *,
    radius: float | Rows | None = None,
    groups: Rows | None = None,
    neighbor_bytes: int = search.BYTES_PER_NEIGHBOR + 1,
    **_: Any,
) -> float:
    count, each = self._asked_rows(queries), _mean_count(self, queries, radius, groups)
    rows, notes = count * (self._row_bytes() + 24 + neighbor_bytes * each), search.notes_bytes(count, self._device)
    if self._skin is None or queries is not None:
        return notes + rows
    # Notes are taken while lists are made, and given back before the rows.
    return _verlet_bytes(self) + max(notes, rows)


def _verlet_bytes(self: Any) -> float:
    """Of lists that are not made yet."""
    if self._skin is None or self._lists is not None:
        return 0.0
    return float(self._count * (40 + 4 * _mean_count(self, None, self._radius + self._skin, None)))


def _candidate_bytes(self: Any, **_: Any) -> float:
    if self._skin is None or (self._lists is not None and self._lists.has_candidates):
        return 0.0
    each = _mean_count(self, None, self._radius + self._skin, None)
    size = 4 if self._cell is None else 16
    return _verlet_bytes(self) + max(search.notes_bytes(self._count, self._device), self._count * (16 + size * each))


@shows_arguments
class NeighborGrid:
    """Points prepared for neighbor searches.

    The points are copied as float64 and sorted into cells of about the radius. Memory: 40 to 64 bytes a point, plus up
    to 28 more during sorting, for any extent of the points.

    Results are exact: point j is a neighbor of query i if ``(dx * dx + dy * dy) + dz * dz <= radius * radius`` holds in
    float64, term by term, for the coordinates as given. They are the same on every device, for any number of threads
    and any order of the queries.

    A pickle or a deep copy carries the points, as NumPy, and sorts them again, on the same device if there is one of
    that name.

    With ``groups`` many clouds are searched in one call. Each query finds points of its own group only, and every
    answer has the bits of a grid over that group alone, with indices among all points.

    With ``periodic`` the points repeat in all three directions, and radius searches find the images within any radius:
    those at half the cell and less are the nearest images, beyond it there are several of a point. Points and queries
    may lie anywhere, and are moved into the cell first, with one rounding of each coordinate where they were outside.
    The coordinates of an image are the point's plus ``shift @ cell``, rounded term by term.

    Exactness is tested for radii of 1e-3 to 1e3 spacings, clouds of 1e-6 to 1e15 radii, any crowding, and 1000 points
    in one place.

    Args:
        points: Positions [world], shape (N, 3), float32 or float64, in any supported container.
        radius: Search radius [world] that the cells are made for, and the default radius of searches. None for twice
            the spacing of the points (about 30 neighbors in a volume, 12 on a surface); the cells are then made by the
            first radius search. Of groups the median spacing.
        groups: Offsets of groups in the points, shape (G + 1,), from 0 to N: group g is the points
            ``groups[g] .. groups[g + 1] - 1``. Groups may be empty. None for one set of points.
        periodic: Cell in which the points repeat [world]: the edges of a box along the axes, shape (3,), or the vectors
            of a triclinic cell as rows, shape (3, 3). With it ``count``, ``radius_search``, ``radius_search_blocks``
            and ``neighbor_list`` work. Memory grows with the images within the radius of the cell. None for none.
        skin: For points that :meth:`update` moves a little at a time: pairs within the radius and the skin [world] are
            listed (a Verlet list), and searches of the points themselves within the radius compare those alone, until
            a point has moved by half the skin. Answers are the same; order "any" is "index" then. Memory: 4 bytes for
            each listed pair, and 120 a point. None for no lists.
        device: Where the points live and queries run: "cpu", "cuda:0", ...; None for the first GPU, else the CPU. A
            list of devices, or ``"cuda:*"`` for all GPUs, has the points on each: they share ``count``,
            ``radius_search``, ``knn`` and ``hybrid`` of 65,536 given queries or more (in arrays on a GPU 33 million),
            and the first does all else.
    Raises:
        InputError: points is not (N, 3), not finite, or its extent overflows float64; radius is negative or not a
            finite number; skin is not a positive number; groups are not offsets from 0 to N; periodic spans no volume,
            is given with groups, or a point is more than 2^24 cells away from it; there is no such device.
        DeviceMemoryError: The images within the radius do not fit in memory.
    Source:
        Green, Particle Simulation using CUDA (2010). Differs: float64 decides where float32 leaves a doubt; x-rows of
        cells are read as one range; a table over leading key bits bounds the memory for any extent.
    Example:
        >>> grid = NeighborGrid([[0, 0, 0], [1, 0, 0], [3, 0, 0]], 1.0, device="cpu")
        >>> grid.count([[0, 0, 0]]).tolist()
        [2]
        >>> pairs = NeighborGrid([[0, 0, 0], [1, 0, 0], [1, 0, 0], [2, 0, 0]], 1.0, groups=[0, 2, 4], device="cpu")
        >>> pairs.radius_search([[1.5, 0, 0], [1.5, 0, 0]], groups=[0, 1, 2]).indices.tolist()
        [1, 2, 3]

        >>> box = NeighborGrid([[0.1, 0, 0], [0.9, 0, 0]], 0.3, periodic=[1, 1, 1], device="cpu")
        >>> box.neighbor_list(exclude_self=True).shifts.tolist()
        [[-1, 0, 0], [1, 0, 0]]
    """

    # Holds recordings of small queries.
    _cache = CacheAttribute()

    def __new__(cls, *_: Any, device: Devices = None, **__: Any) -> NeighborGrid:
        shared = cls is NeighborGrid and launcher.is_several(device)
        return object.__new__(_GridOnDevices if shared else cls)

    @needs(lambda self, points, *_, **__: 48 * rows(points))
    def __init__(
        self,
        points: Rows,
        radius: float | None = None,
        *,
        groups: Rows | None = None,
        periodic: Any = None,
        skin: float | None = None,
        device: Devices = None,
    ) -> None:
        wanted = None if radius is None else _require_radius(radius)
        self._device = launcher.resolve_device(device)
        self._cell = None if periodic is None else read_cell(periodic)
        self._skin = None if skin is None else _require_skin(skin, wanted)
        if self._cell is not None and groups is not None:
            raise InputError("periodic: groups have no common cell; make a grid for each, or leave one of both out")
        self._hold(points, wanted, groups)

    def _hold(self, points: Any, wanted: float | None, groups: Any, count: int | None = None) -> None:
        """Take the points, which are ``count`` if given."""
        import warp as wp

        points, tracked = split(points)
        if tracked is not None:
            hold(self, points=tracked)
        cell = self._cell
        keeps = wanted is not None and cell is None and self._skin is None
        batch = read_vectors(points, "points", self._device, defer=True, keep_float32=keeps)
        rows = batch.array
        if count is not None and len(rows) != count:
            raise InputError(
                f"points: {len(rows)} rows for a grid of {count} points; make a new NeighborGrid for others"
            )
        # Container and device for results about the points themselves; the points are not kept.
        self._home, self._count = Batch(None, batch.is_float32, batch.to_caller), len(rows)
        self._survey = survey(rows, lambda: require_finite(batch, "points"))
        offsets = None if groups is None else read_offsets(groups, self._count, "points")
        self._groups = None if offsets is None else survey_groups(rows, offsets)
        self._spacing = (
            usual_spacing(self._survey, self._count) if self._groups is None else usual_spacing_of(self._groups)
        )
        # Points that coincide have no spacing; any radius serves.
        self._radius = (SPACINGS * self._spacing or 1.0) if wanted is None else wanted
        # Each entry is a set of cells with the least radius that it suits: the cells of the grid's radius, and the
        # cells of the last query radius that needed its own. Without a radius the points stay unsorted until the first
        # radius search.
        # Held while these are made and while cells are chosen: threads may ask for other radii.
        self._lock = Lock()
        self._own: tuple[Cells, float] | None = None
        self._other: tuple[Cells, float] | None = None
        self._rows: Any = None
        self._made_images: Images | None = None
        # With a skin, the candidates of the points, and nothing else until another search needs it.
        self._lists: VerletLists | None = None
        self._farthest = float(max(np.abs(self._survey.lower).max(), np.abs(self._survey.upper).max()))
        if cell is not None:
            _require_near(self._farthest, cell, "points")
        if cell is not None and self._skin is None:
            self._fill_cell(wp.clone(rows), cell, self._radius)
        elif wanted is None or self._skin is not None:
            self._rows = wp.clone(rows)
        else:
            self._own = self._built(rows, self._radius)
        self._tree: Any = None
        self._hash_grid: Any = None

    @needs(lambda self, points, **_: 48 * rows(points))
    def update(self, points: Rows) -> None:
        """Move the points, all of them, in place.

        Afterwards all answers equal those of a new NeighborGrid of these points with the grid's radius, cell, groups
        and skin: the same sets, in the same order, with the same bits. Results are in the container of the new points.

        Without a skin the points are sorted again, which takes as long as making a new grid. With ``skin``, the
        candidates of the points themselves are kept until a point has moved by half the skin since they were found.
        In a periodic cell a point may be moved by whole cells besides.

        Searches that run in other threads meanwhile answer for the points that the grid had when they began. The
        :attr:`id` changes.

        Args:
            points: New positions [world], shape (N, 3), for the same number of points.
        Raises:
            InputError: The number of points differs, a row is not finite, or the points spread too far; the grid is
                unchanged then.
            DeviceMemoryError: They do not fit in memory; the grid is unchanged then.
        Example:
            >>> grid = NeighborGrid([[0, 0, 0], [1, 0, 0]], 1.0, skin=0.5, device="cpu")
            >>> grid.count().tolist()
            [2, 2]
            >>> grid.update([[0, 0, 0], [1.1, 0, 0]])
            >>> grid.count().tolist()
            [1, 1]
        """
        moved: NeighborGrid = object.__new__(type(self))
        moved._device, moved._cell, moved._skin = self._device, self._cell, self._skin
        groups = None if self._groups is None else self._groups.offsets
        moved._hold(points, self._radius, groups, self._count)
        lists = self._lists
        if lists is not None:
            moved._lists = lists.followed(moved._rows, moved._farthest)
        self.__dict__ = moved.__dict__  # at once: see snapshot

    def _row_bytes(self) -> int:
        """Of a query that is moved into a cell."""
        return 0 if self._cell is None else 40

    def _asked_rows(self, queries: Any) -> int:
        return self._count if queries is None else rows(queries)

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

        Raises:
            InputError: The grid has groups or is periodic.
        """
        self._refuse_in_kernels("id", "a wp.HashGrid")
        with self._lock:
            if self._hash_grid is None:
                # Warp needs a positive cell length even if the radius is 0.
                self._hash_grid = _hash_grid_of(self._points(), self._radius or self._spacing or 1.0)
            return int(self._hash_grid[0].id)

    @needs(lambda self: 48 * self._count)
    def on_kernel(self) -> InKernels:
        """The points for the user's own kernels, which call :mod:`geokit.kernels` on them: exact, as the searches.

        Unlike :attr:`id` it needs no memory of its own, keeps what it refers to alive, and shows the points as they are
        now: ask again after :meth:`update`. It is one of ``device``.

        Returns:
            A ``geokit.kernels.NeighborGrid``, for a parameter of that type.
        Raises:
            InputError: The grid has groups or is periodic.
        """
        from geokit.points.neighbors import user_kernels as kernels

        self._refuse_in_kernels("on_kernel", "kernels")
        found: Any = kernels.NeighborGrid()
        found.cells = self._cells.grid
        return handed_out(found, self._device, self)

    def _refuse_in_kernels(self, name: str, who: str) -> None:
        if self._groups is not None:
            raise InputError(f"groups: {who} cannot tell them apart; make a grid for each, or without groups")
        self._refuse_periodic(name, f"{who} cannot find images")

    def __len__(self) -> int:
        return self._count

    def __reduce__(self) -> Any:
        # Cells hold addresses: they are made again where the points arrive.
        rows = self._given().numpy()
        points = rows.astype(np.float32) if self._home.is_float32 else rows
        groups = None if self._groups is None else self._groups.offsets
        return _restored, (points, self._radius, self.device, groups, self._cell, self._skin)

    def __repr__(self) -> str:
        groups = "" if self._groups is None else f" in {len(self._groups.offsets) - 1} groups"
        groups += "" if self._cell is None else " in a periodic cell"
        skin = "" if self._skin is None else f", skin={self._skin:g}"
        return f"NeighborGrid({self._count} points{groups}, radius={self._radius:g}{skin}, device={self.device!r})"

    @query(
        "queries",
        is_replayed=True,
        is_stepped=True,
        least_rows=LEAST_COUNTED_ON_GPUS,
        memory=lambda self, queries=None, **_: (40 + self._row_bytes()) * self._asked_rows(queries),
    )
    def count(
        self,
        queries: Rows | None = None,
        *,
        radius: float | Rows | None = None,
        exclude_self: bool = False,
        groups: Rows | None = None,
    ) -> Array:
        """Count the points within the radius of each query.

        Args:
            queries: Positions [world], shape (Q, 3), float32 or float64; None for the points themselves, which is
                faster than passing them again.
            radius: Search radius [world], or one for each query, shape (Q,); None for the radius of the grid. A radius
                more than twice as long or less than half as long sorts the points again; the last such radius is
                cached.
            exclude_self: Query i stands for point i, at any position, and does not count it. Only that index is left
                out, not other points at the same position.
            groups: For a grid with groups: offsets (G + 1,) of the queries' groups, which are packed like the points;
                neighbors are points of the query's group. None for the points themselves.
        Returns:
            Counts (Q,) int32, in the container of the queries.
        Raises:
            InputError: queries is not (Q, 3) or not finite; a radius is negative or not a finite number, or radius has
                neither one nor Q entries; exclude_self is given and the number of queries is not the number of points;
                groups are not offsets of the queries.
        """
        if (listed := self._listed(queries, radius, exclude_self, groups)) is not None:
            lists, within = listed
            return self._home.to_caller(lists.count(within, exclude_self))
        asked, home = self._ask(queries, radius, exclude_self, groups)
        return home.to_caller(search.count(asked))

    @query("queries", gradient="..gradients.distances:WITHIN", least_rows=LEAST_QUERIES_ON_GPUS, memory=_list_bytes)
    def radius_search(
        self,
        queries: Rows | None = None,
        *,
        radius: float | Rows | None = None,
        exclude_self: bool = False,
        order: str = "index",
        groups: Rows | None = None,
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
            groups: For a grid with groups: offsets (G + 1,) of the queries' groups, which are packed like the points;
                neighbors are points of the query's group. None for the points themselves.
        Returns:
            Neighbors with offsets (Q + 1,) int64, indices (M,) int32 and distance (M,) [world], in the container of
            the queries; distance is float32 for float32 queries.
        Raises:
            InputError: queries is not (Q, 3) or not finite; a radius is negative or not a finite number, or radius has
                neither one nor Q entries; exclude_self is given and the number of queries is not the number of points;
                order is not known; groups are not offsets of the queries.
            DeviceMemoryError: The neighbors do not fit in memory, or number more than 2^31 - 1 in all; nothing has been
                allocated for them. :meth:`radius_search_blocks` returns them block by block.
        """
        _require_order(order)
        if (listed := self._listed(queries, radius, exclude_self, groups)) is not None:
            lists, within = listed
            offsets, indices, distance = lists.search(within, exclude_self, order, self._home.is_float32)
            return Neighbors(*map(self._home.to_caller, (offsets, lists.named(indices), distance)))
        asked, home = self._ask(queries, radius, exclude_self, groups)
        return Neighbors(
            *map(
                home.to_lists or home.to_caller,
                self._filled(asked, search.count(asked, note=True), order, home.is_float32),
            )
        )

    @query(
        "queries",
        gradient="..gradients.distances:IMAGES",
        least_rows=LEAST_QUERIES_ON_GPUS,
        memory=lambda self, queries=None, **given: 1.1 * _list_bytes(self, queries, **given),
    )
    def neighbor_list(
        self,
        queries: Rows | None = None,
        *,
        radius: float | Rows | None = None,
        exclude_self: bool = False,
        order: str = "index",
    ) -> NeighborList:
        """Find the images of points within the radius of each query in a periodic cell, with their shifts.

        A neighbor is an image of a point, at ``points[indices] + shifts @ cell``, and ``distance`` is that from the
        query to this position. Where the radius is longer than half the cell, a point is listed with several shifts,
        and a query that is a point also with its own images.

        Args:
            queries: Positions [world], shape (Q, 3), float32 or float64; None for the points themselves.
            radius: Search radius [world], or one for each query, shape (Q,); None for the radius of the grid. A radius
                longer than any before makes more images.
            exclude_self: Leave out each point at shift 0, for the points themselves. Their other images are found.
            order: Order within a row. "index": ascending index, then shift. "distance": ascending float64 distance,
                then index, then shift. "any": the order of the cells.
        Returns:
            NeighborList with offsets (Q + 1,) int64, indices (M,) int32, distance (M,) [world] and shifts (M, 3) int32,
            in the container of the queries; distance is float32 for float32 queries.
        Raises:
            InputError: The grid is not periodic; queries is not (Q, 3), not finite, or too far from the cell; a radius
                is negative or not a finite number, or radius has neither one nor Q entries; exclude_self is given with
                queries; order is not known.
            DeviceMemoryError: The neighbors, or the images, do not fit in memory.
        """
        import warp as wp

        if self._cell is None:
            raise InputError("neighbor_list: the grid is not periodic; give periodic=, or use radius_search()")
        _require_order(order)
        if (listed := self._listed(queries, radius, exclude_self)) is not None:
            lists, within = listed
            offsets, indices, distance = lists.search(within, exclude_self, order, self._home.is_float32)
            shifts = lists.shifts(offsets, indices)
            return NeighborList(*map(self._home.to_caller, (offsets, lists.named(indices), distance, shifts)))
        asked, home = self._ask(queries, radius, exclude_self)
        assert asked.images is not None
        turn = asked.images.turn if asked.turn is None else asked.turn
        *found, shifts = self._filled(asked, search.count(asked, note=True), order, home.is_float32, turn)
        found.append(reinterpreted(shifts, wp.int32, (len(shifts), 3)))
        return NeighborList(*map(home.to_lists or home.to_caller, found))

    @query(is_stepped=True, memory=_candidate_bytes)
    def candidates(self, *, exclude_self: bool = False) -> Candidates:
        """List for each point those that may be within the radius, for a grid with a skin.

        For kernels that compute distances themselves, such as forces between particles. All neighbors within the radius
        are listed, and others up to the radius plus twice the skin. The lists are made by the first call, and again
        after an :meth:`update` has moved a point by more than half the skin since. In between the same arrays are
        returned, which takes no time: do not write to them.

        Args:
            exclude_self: Leave out each point in its own row. In a periodic cell its other images are listed.
        Returns:
            Candidates with offsets (N + 1,) int64, indices (M,) int32 and shifts (M, 3) int32, in the container of the
            points; shifts is None for a grid that is not periodic.
        Raises:
            InputError: The grid has no skin.
            DeviceMemoryError: The candidates do not fit in memory.
        Example:
            >>> grid = NeighborGrid([[0, 0, 0], [1, 0, 0], [3, 0, 0]], 1.0, skin=0.5, device="cpu")
            >>> grid.candidates(exclude_self=True).indices.tolist()
            [1, 0]
        """
        require_flag(exclude_self, "exclude_self")
        listed = self._listed(None, None, exclude_self)
        if listed is None:
            raise InputError("candidates: the grid has no skin; give skin=, or use radius_search()")
        give = self._home.to_caller
        offsets, indices, shifts = listed[0].candidates(exclude_self)
        return Candidates(give(offsets), give(indices), None if shifts is None else give(shifts))

    @query("queries")
    def radius_search_blocks(
        self,
        queries: Rows | None = None,
        *,
        radius: float | Rows | None = None,
        exclude_self: bool = False,
        order: str = "index",
        memory: int | None = None,
        groups: Rows | None = None,
    ) -> Iterator[NeighborBlock]:
        """Find the points within the radius of each query, one block of queries at a time.

        The rows are those of :meth:`radius_search`, but the neighbors of all queries need not fit in memory at once.
        All arguments are checked and all neighbors counted before the first block; each block is computed on demand.

        Args:
            queries, radius, exclude_self, groups: As for :meth:`radius_search`.
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
                order is not known; memory is not a positive number; groups are not offsets of the queries.
            DeviceMemoryError: The neighbors of one query do not fit in memory.
        Example:
            >>> grid = NeighborGrid([[0, 0, 0], [1, 0, 0], [3, 0, 0]], 1.0, device="cpu")
            >>> [(first, found.indices.tolist()) for first, found in grid.radius_search_blocks(memory=24)]
            [(0, [0, 1]), (1, [0, 1]), (2, [2])]
        """
        _require_order(order)
        if queries is None and self._skin is not None and order == "any":
            order = "index"
        budget = (
            int(BLOCK_SHARE * available_memory.available(self._device))
            if memory is None
            else require_count(memory, "memory", 1)
        )
        batch = self._own_batch() if queries is None else self._read_queries(queries, exclude_self)[0]
        radii = self._radii(radius, len(batch))
        _require_self(exclude_self, len(batch), self._count)
        offsets = self._groups_of(groups, None if queries is None else len(batch), exclude_self)
        group = None if offsets is None else numbers_of(offsets, self._device)
        counts = search.count(self._asked(batch.array, len(batch), radii, exclude_self, group=group)).numpy()
        return self._blocks(batch, radii, exclude_self, order, counts, budget, group)

    @query(memory=lambda self, **given: _list_bytes(self, **given, neighbor_bytes=search.BYTES_PER_NEIGHBOR + 9))
    def pairs(self, *, radius: float | None = None) -> Pairs:
        """Find all pairs of points within the radius of each other, each pair once; in groups, of one group.

        Args:
            radius: Search radius [world]; None for the radius of the grid.
        Returns:
            Pairs with indices (M, 2) int32, i < j, ascending, and distance (M,) [world], in the container of the
            points.
        Raises:
            InputError: radius is negative or not a finite number; the grid is periodic.
            DeviceMemoryError: The neighbors of all points, found first, do not fit in memory or number more than 2^31 -
                1.
        """
        import warp as wp

        from geokit.points.search import radius_cuda_kernels as kernels

        self._refuse_periodic("pairs", "a point may be its own neighbor; use neighbor_list()")
        radius = None if radius is None else _require_radius(radius)
        home = self._home
        if (listed := self._listed(None, radius, False)) is not None:
            lists, within = listed
            offsets, indices, distance = lists.search(within, False, "index", False)
        else:
            asked, home = self._ask(None, radius, False, None)
            offsets, indices, distance = self._filled(asked, search.count(asked, note=True), "index", single=False)
        counts = wp.empty(self._count, dtype=wp.int32, device=self._device)
        launcher.launch(kernels.pair_count_kernel, self._count, [offsets, indices], [counts], self._device)
        starts = row_offsets(counts)
        total = int(starts[self._count :].numpy()[0])
        pairs = wp.empty((total, 2), dtype=wp.int32, device=self._device)
        lengths = wp.empty(total, dtype=wp.float64, device=self._device)
        given = [offsets, indices, distance, starts]
        launcher.launch(kernels.pair_fill_kernel, self._count, given, [pairs, lengths], self._device)
        return Pairs(home.to_caller(pairs), home.to_caller(lengths))

    @query(
        "queries",
        gradient="..gradients.distances:NEAREST",
        is_replayed=True,
        least_rows=LEAST_QUERIES_ON_GPUS,
        memory=lambda self, queries=None, k=1, **_: (60 + 12 * k) * self._asked_rows(queries),
    )
    def knn(
        self, queries: Rows | None = None, k: int = 1, *, exclude_self: bool = False, groups: Rows | None = None
    ) -> KNearest:
        """Find the k nearest points of each query at any distance.

        Exact: the k smallest values of ``(dx * dx + dy * dy) + dz * dz`` in float64, each operation rounded once; ties
        go to the lower index. The result is the same on every device. The first call builds a tree over the points
        (about 60 bytes a point), which is kept.

        Args:
            queries: Positions [world], shape (Q, 3), float32 or float64; None for the points themselves.
            k: Number of neighbors, 1 to 1024.
            exclude_self: Query i stands for point i and does not find it; other points at the same position are found.
            groups: For a grid with groups: offsets (G + 1,) of the queries' groups, which are packed like the points;
                neighbors are points of the query's group. None for the points themselves.
        Returns:
            KNearest with distance (Q, k) [world], the nearest first, and indices (Q, k) int32, in the container of the
            queries; inf and -1 fill rows with fewer than k points. distance is float32 for float32 queries.
        Raises:
            InputError: queries is not (Q, 3) or not finite; k is not a whole number from 1 to 1024; exclude_self is
                given and the number of queries is not the number of points; groups are not offsets of the queries; the
                grid is periodic.
            DeviceMemoryError: The results do not fit in memory.
        Example:
            >>> grid = NeighborGrid([[0, 0, 0], [1, 0, 0], [3, 0, 0]], device="cpu")
            >>> grid.knn([[2.5, 0, 0]], k=2).indices.tolist()
            [[2, 1]]
        """
        return self._nearest(queries, k, np.inf, exclude_self, groups)

    @query(
        "queries",
        gradient="..gradients.distances:NEAREST",
        is_replayed=True,
        least_rows=LEAST_QUERIES_ON_GPUS,
        memory=lambda self, queries=None, k=1, **_: (60 + 12 * k) * self._asked_rows(queries),
    )
    def hybrid(
        self,
        queries: Rows | None = None,
        k: int = 1,
        *,
        radius: float | Rows | None = None,
        exclude_self: bool = False,
        groups: Rows | None = None,
    ) -> KNearest:
        """Find the k nearest points within the radius of each query.

        Exact: among the points with ``(dx * dx + dy * dy) + dz * dz <= radius * radius`` in float64, each operation
        rounded once, those with the k smallest values of the left side; ties go to the lower index. A point at exactly
        the radius counts.

        Args:
            queries, k, exclude_self, groups: As for :meth:`knn`.
            radius: Search radius [world], or one for each query, shape (Q,); None for the radius of the grid.
        Returns:
            KNearest with distance (Q, k) [world], the nearest first, and indices (Q, k) int32, in the container of the
            queries; inf and -1 fill rows with fewer than k points within the radius. distance is float32 for float32
            queries.
        Raises:
            InputError: queries is not (Q, 3) or not finite; k is not a whole number from 1 to 1024; a radius is
                negative or not a finite number, or radius has neither one nor Q entries; exclude_self is given and the
                number of queries is not the number of points; groups are not offsets of the queries; the grid is
                periodic.
            DeviceMemoryError: The results do not fit in memory.
        """
        return self._nearest(queries, k, radius, exclude_self, groups)

    def _nearest(self, queries: Any, k: int, radius: Any, exclude_self: bool, groups: Any) -> KNearest:
        import warp as wp

        self._refuse_periodic("knn and hybrid", 'use neighbor_list(order="distance")')
        k = require_k(k)
        batch = (
            None
            if queries is None
            else read_vectors(queries, "queries", self._device, largest=LARGEST_MEASURED, single=True)
        )
        if self._farthest > LARGEST_MEASURED:
            raise InputError(
                f"points: they lie farther than {LARGEST_MEASURED:g} from the origin, where squares of distances leave "
                "float64; scale them down, with the queries"
            )
        count = self._count if batch is None else len(batch)
        limit = radius if isinstance(radius, float) and radius == np.inf else self._radii(radius, count)
        _require_self(exclude_self, count, self._count)
        offsets = self._groups_of(groups, None if batch is None else count, exclude_self)
        own = None if self._groups is None else self._groups.offsets
        with self._lock:
            if self._tree is None:
                self._tree = build_tree(self._points(), own)
        with np.errstate(over="ignore"):
            squared = np.square(limit)
        if np.ndim(squared):
            squared = wp.array(squared, dtype=wp.float64, device=self._device)
        rows, give = (None, self._home.to_caller) if batch is None else (batch.array, batch.to_caller)
        pair = None if own is None or offsets is None else (own, offsets)
        found = nearest(self._tree, k, rows, limit_squared=squared, exclude_self=exclude_self, groups=pair)
        return KNearest(*map(give, found))

    def _refuse_periodic(self, what: str, remedy: str) -> None:
        if self._cell is not None:
            raise InputError(f"periodic: not for {what}: {remedy}")

    @property
    def _images(self) -> Images | None:
        """Images of the points in a periodic cell, made when they are first needed."""
        if self._cell is None:
            return None
        with self._lock:
            if self._made_images is None:
                self._fill_cell(self._rows, self._cell, self._radius + (self._skin or 0.0))
            return self._made_images

    def _listed(
        self, queries: Any, radius: Any, exclude_self: bool, groups: Rows | None = None
    ) -> tuple[VerletLists, float] | None:
        """The lists of a grid with a skin, and the radius, if they answer a search."""
        if self._skin is None or queries is not None:
            return None
        within = self._radii(radius, self._count)
        if np.ndim(within) or within > self._radius:
            return None
        require_flag(exclude_self, "exclude_self")
        self._groups_of(groups, None, exclude_self)
        with self._lock:
            if self._lists is None:
                self._lists = self._found_lists(self._radius + self._skin)
            return self._lists, within

    def _found_lists(self, reach: float) -> VerletLists:
        points, asked = self._given(), self._asked(None, self._count, reach, False)

        def refuse(total: int) -> None:
            # On a GPU the search that finds them makes distances, too.
            search.require_room(total, self._count, self._device, 4 if self._device.is_cpu else 12)

        return VerletLists(asked, points, self._radius, reach, asked.images, self._farthest, refuse)

    def _fill_cell(self, points: "wp.array", cell: NDArray[np.float64], reach: float) -> None:
        """Take the points (N,) and their images within ``reach`` of the cell for the points that are searched."""
        # If there is no room for them, the grid is as it was.
        images = Images(points, cell, reach)
        prepared.refuse()
        self._cache.clear()
        self._own = self._other = None
        self._made_images, self._rows = images, images.points
        self._survey = survey(images.points)

    def _read_queries(self, queries: Any, exclude_self: bool) -> tuple[Batch, Any]:
        """Checked queries, and by how many cells they were outside a periodic one, in which they are now."""
        keeps = self._device.is_cuda and self._cell is None
        batch = read_vectors(queries, "queries", self._device, keep_float32=keeps, single=True)
        images = self._images
        if images is None:
            return batch, None
        if require_flag(exclude_self, "exclude_self"):
            raise InputError("exclude_self: queries in a periodic cell may be images of a point; leave queries out")
        rows = batch.array
        if len(rows):
            box = survey(rows, lambda: require_finite(batch, "queries"))
            _require_near(max(np.abs(box.lower).max(), np.abs(box.upper).max()), images.cell, "queries")
        inside, turn = images.wrapped(rows)
        return replace(batch, rows=inside), turn

    def _groups_of(self, groups: Any, count: int | None, exclude_self: bool) -> NDArray[np.int64] | None:
        """Offsets of the queries' groups, None if the grid has none; ``count`` is None for the points themselves."""
        if self._groups is None:
            if groups is not None:
                raise InputError("groups: the points have none; make the NeighborGrid with groups= too")
            return None
        own = self._groups.offsets
        if count is None:
            if groups is not None:
                raise InputError(
                    "groups: the points themselves have those of the grid; leave groups out, or give queries"
                )
            return own
        if groups is None:
            raise InputError(f"groups: the grid has {len(own) - 1}; give the offsets ({len(own)},) of the queries too")
        captured.refuse(self._device, "groups: offsets are copied from the host")
        offsets = read_offsets(groups, count, "queries")
        if len(offsets) != len(own):
            raise InputError(f"groups: {len(offsets) - 1} are not the {len(own) - 1} of the grid; empty ones count")
        if exclude_self and (offsets != own).any():
            row = int(np.argmax(offsets != own))
            raise InputError(
                f"groups: row {row} is {offsets[row]}, of the points {own[row]}; with exclude_self query i is in the "
                "group of point i"
            )
        return offsets

    def _ask(self, queries: Any, radius: Any, exclude_self: bool, groups: Any = None) -> tuple[search.Asked, Batch]:
        """The checked queries with their radii, and the batch that returns results in their container."""
        if queries is None:
            require_flag(exclude_self, "exclude_self")
            radii = self._radii(radius, self._count)
            self._groups_of(groups, None, exclude_self)
            return self._asked(None, self._count, radii, exclude_self), self._home
        batch, turn = self._read_queries(queries, exclude_self)
        radii = self._radii(radius, len(batch))
        _require_self(exclude_self, len(batch), self._count)
        offsets = self._groups_of(groups, len(batch), exclude_self)
        group = None if offsets is None else numbers_of(offsets, self._device)
        asked = self._asked(batch.array, len(batch), radii, exclude_self, group=group)
        asked.turn = turn
        return asked, batch

    def _asked(
        self, rows: Any, count: int, radii: Any, exclude_self: bool, first_point: int = 0, group: Any = None
    ) -> search.Asked:
        options: Any = {"own": exclude_self, "first_point": first_point, "group": group}
        chosen = functools.partial(search.Asked, rows, count, radii, self._cells_for, self._device, **options)
        if self._cell is None:
            return chosen()
        longest = float(np.max(radii, initial=0.0))
        with self._lock:
            # Cells are those of the images, until another thread needs more of them.
            images = self._images
            if images is not None and longest > images.reach:
                self._fill_cell(images.given, images.cell, longest)
            asked = chosen()
            asked.images = self._images
        return asked

    @needs(name="radius_search_blocks")
    def _filled(
        self, asked: search.Asked, counts: "wp.array", order: str, single: bool, turn: Any = None
    ) -> tuple[Any, ...]:
        """Rows of neighbors: indices of points, distances, and for queries ``turn`` the shifts of images."""

        def refuse(total: int) -> None:
            search.require_room(total, asked.count, self._device)

        images = asked.images
        if images is not None and order != "any":
            # By index, everything takes one pass over the neighbors.
            found = images.listed(*search.fill(asked, counts, refuse, single=single and order != "distance"), turn)
            return found if order == "index" else sort_by_distance(*found)
        if order == "distance":
            # Rows are sorted by float64 distances, so the order in which they are filled does not matter.
            found = search.fill(asked, counts, refuse, order="any")
            search.sort_by_distance(*found)
            return found
        offsets, indices, distance = search.fill(asked, counts, refuse, order=order, single=single)
        if images is None:
            return offsets, indices, distance
        shifts = [] if turn is None else [images.shifts(offsets, indices, turn)]
        return offsets, images.named(indices), distance, *shifts

    def _blocks(
        self, batch: Batch, radii: Any, exclude_self: bool, order: str, counts: np.ndarray, budget: int, group: Any
    ) -> Iterator[NeighborBlock]:
        for begin, end in search.blocks_of(counts, budget):
            part = radii if np.ndim(radii) == 0 else radii[begin:end]
            numbers = None if group is None else group[begin:end]
            yield self._block(batch, part, exclude_self, order, counts[begin:end], begin, numbers)

    @needs(name="radius_search_blocks")
    def _block(
        self, batch: Batch, radii: Any, exclude_self: bool, order: str, counts: np.ndarray, begin: int, group: Any
    ) -> NeighborBlock:
        import warp as wp

        rows = batch.array[begin : begin + len(counts)].contiguous()
        asked = self._asked(rows, len(counts), radii, exclude_self, begin, group)
        known = wp.array(counts, dtype=wp.int32, device=self._device)
        found = self._filled(asked, known, order, batch.is_float32)
        return NeighborBlock(begin, Neighbors(*map(batch.to_lists or batch.to_caller, found)))

    def _own_batch(self) -> Batch:
        images = self._images
        rows = self._points() if images is None else images.inside
        return Batch(rows, self._home.is_float32, self._home.to_caller)

    def _radii(self, radius: Any, count: int) -> Any:
        """One radius, or an array with one for each query."""
        if radius is None:
            return self._radius
        radii = _require_radii(radius, count)
        if np.ndim(radii):
            captured.refuse(self._device, "radius: one for each query is copied from the host")
        return radii

    def _cells_for(self, radius: float) -> Cells:
        with self._lock:
            for cells, least in filter(None, (self._sorted(), self._other)):
                if least <= radius <= RADIUS_RATIO * cells.radius:
                    return cells
            # Release the old cells first: both may not fit in memory at once.
            prepared.refuse()
            self._cache.clear()
            self._other = None
            self._other = self._built(self._points(), radius)
            return self._other[0]

    def _sorted(self) -> tuple[Cells, float]:
        """The cells for the grid's own radius."""
        with self._lock:
            if self._own is None:
                self._own = self._built(self._points(), self._radius + (self._skin or 0.0))
                self._rows = None
            return self._own

    @property
    def _cells(self) -> Cells:
        return self._sorted()[0]

    def _points(self) -> "wp.array":
        """The points that are searched as vec3d, in their original order; images follow."""
        images = self._images
        if images is not None:
            return images.points
        rows = self._rows  # another thread may sort them meanwhile
        return search.points_of(self._cells.grid) if rows is None else rows

    def _given(self) -> "wp.array":
        """The points as they were given, as vec3d."""
        if self._cell is None:
            return self._points()
        with self._lock:
            return self._rows if self._made_images is None else self._made_images.given

    def _built(self, rows: "wp.array", radius: float) -> tuple[Cells, float]:
        """Cells that suit a radius, and the least radius that they suit.

        If few points lie within the radius of each other, longer cells are faster: there are fewer cells to look up.
        """
        edge = radius or LEAST_OF_SPACING * self._spacing or 1.0
        if self._groups is not None:
            return build_group_cells(rows, self._groups, edge), radius / RADIUS_RATIO
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


def _require_radius(radius: Any) -> float:
    return require_finite_scalar(radius, "radius", low=FROM_ZERO)


def _require_skin(skin: Any, radius: float | None) -> float:
    value = require_finite_scalar(skin, "skin", low=0.0)
    if not np.isfinite(value + (radius or 0.0)):
        raise InputError(f"skin: {value:g} and the radius are more than a float64 can hold; scale the points down")
    return value


def _require_radii(radius: Any, count: int) -> float | np.ndarray:
    values = read_numbers(radius, "radius")
    if values.ndim == 0:
        return _require_radius(values)
    if values.shape != (count,):
        raise InputError(f"radius: shape {values.shape} is not one number, nor one for each of the {count} queries")
    bad = ~(np.isfinite(values) & (values >= 0.0))
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"radius: row {row} is {values[row]:g}; give finite numbers that are 0 or more")
    return values


def _require_order(order: str) -> None:
    require_choice(order, "order", ("index", "distance", "any"))


def _require_self(exclude_self: bool, query_count: int, point_count: int) -> None:
    if require_flag(exclude_self, "exclude_self") and query_count != point_count:
        raise InputError(
            f"exclude_self: {query_count} queries are not the {point_count} points; leave queries out, or exclude_self"
        )


def _require_near(farthest: float, cell: NDArray[np.float64], name: str) -> None:
    """Refuse coordinates so far from the cell that moved into it they would have few digits left."""
    height = 1.0 / np.sqrt((np.linalg.inv(cell) ** 2).sum(axis=0)).max()
    if farthest > height * MOST_TURNS:
        raise InputError(
            f"{name}: a coordinate is {farthest:g}, more than {MOST_TURNS} cells of {height:g} away from the periodic "
            "cell; move it nearer by whole cells"
        )


def _hash_grid_of(points: "wp.array", cell_size: float) -> tuple[Any, "wp.array"]:
    """Build a ``wp.HashGrid`` over vec3d points cast to float32; returns the grid and the cast points.

    Warp's grid may store the address of the points without keeping the array alive: keep a reference to both.
    """
    import warp as wp

    device: Any = points.device
    single = narrowed(points, wp.vec3f)
    # Begin and end of each cell; cell and number of each point, twice, for the sort.
    with allocating(device, 8 * HASH_CELLS**3 + 20 * len(points), fatal=True):
        grid = wp.HashGrid(HASH_CELLS, HASH_CELLS, HASH_CELLS, device=device)
        grid.build(single, cell_size)
    return grid, single


class _GridOnDevices(OnDevices, NeighborGrid):
    """A grid with a replica on each of several devices."""

    def __init__(self, points: Any, radius: float | None = None, *, device: Devices = None, **options: Any) -> None:
        self._parts = replicas(lambda one: NeighborGrid(points, radius, device=one, **options), device)

    def update(self, points: Rows) -> None:
        self._update(points)

    def __reduce__(self) -> Any:
        restored, (points, radius, _, *others) = self._parts[0].__reduce__()
        return restored, (points, radius, self._aliases, *others)

    def __len__(self) -> int:
        return len(self._parts[0])

    def __repr__(self) -> str:
        return repr(self._parts[0]).replace(f"device={self.device!r}", f"device={self._aliases!r}")


def _restored(
    points: np.ndarray,
    radius: float,
    device: str | list[str],
    groups: Rows | None = None,
    periodic: Any = None,
    skin: float | None = None,
) -> NeighborGrid:
    take = launcher.device_or_default
    there: Any = [take(one) for one in device] if isinstance(device, list) else take(device)
    return NeighborGrid(points, radius, groups=groups, periodic=periodic, skin=skin, device=there)
