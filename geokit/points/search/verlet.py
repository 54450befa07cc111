"""Verlet lists: candidates of each point, kept while the points move, and compared exactly in each search.

All pairs within the radius and a skin are listed. Two points approach each other by at most the sum of their motions,
so that until a point has moved by half the skin no pair within the radius is missing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from geokit.core import launcher
from geokit.core.base.forks import Lock
from geokit.core.base.late_warp import wp
from geokit.core.memory import host_pool
from geokit.core.scan import gathered, row_offsets
from geokit.points.search import radius as search
from geokit.points.search.periodic import Images, sort_by_distance

# Relative rounding of squared distances, their roots and motions, which is below 1e-15, with room to spare.
ROUNDING = 1e-14
# Squares of shorter motions and distances vanish.
VANISHING = 1e-160
# A list is read in steps of eight candidates.
PADDING = 8
# Points whose motion one item compares on a CPU, and items on a GPU.
MOTION_SHARE = 1 << 13
MOTION_THREADS = 1 << 14
# Lists that are worth a slice: a tenth of a millisecond of work.
GRAIN = 1 << 10


class VerletLists:
    """Candidates of each of N points, and where the points are now.

    Args:
        asked: The points as queries, with the radius and the skin as radius.
        points: The points as given, vec3d (N,); kept.
        radius: Longest search radius [world].
        reach: The radius and the skin [world].
        images: Images within the reach, for a periodic cell.
        farthest: Largest coordinate of the points as given, in magnitude [world].
        refuse: Called with the number of candidates, to raise if it is too large.
    """

    def __init__(
        self,
        asked: search.Asked,
        points: "wp.array",
        radius: float,
        reach: float,
        images: Images | None,
        farthest: float,
        refuse: Callable[[int], None],
    ) -> None:
        from geokit.points.search import verlet_kernels as kernels
        from geokit.points.search.cells_kernels import CellGrid
        from geokit.points.search.neighbors_kernels import Queries
        from geokit.points.search.radius_cpu_kernels import list_kernel

        self._count, self._device, self._radius, self._reach = asked.count, asked.device, radius, reach
        self._images, self._points, self._farthest = images, points, farthest
        self._before = points if images is None else images.inside
        # By how many cells the caller has moved the points since, if any; and what candidates() has made.
        self._leap: Any = None
        self._made: dict[bool, tuple[Any, Any, Any]] = {}
        self._lock = Lock()
        self._lists: Any = kernels.VerletLists()
        lists, device = self._lists, asked.device
        ((grid, queries, _),) = asked.parts
        places = len(grid.index)
        ranks: Any = grid.index
        if images is None:
            lists.of = grid.index
        else:
            lists.cell = images.vectors
            ranks, lists.of = (wp.empty(places, dtype=wp.int32, device=device) for _ in range(2))
            lists.shift = wp.empty(places, dtype=wp.vec3i, device=device)
            given = [grid.index, images.ends, images.of, images.shift]
            launcher.launch(kernels.rank_kernel, places, given, [ranks, lists.of, lists.shift], device)
        # Lists are in the order of the cells, so that those which are read together lie together.
        lists.point = queries.index
        place_of = self._inverse(grid.index, places)
        lists.place = gathered(place_of, queries.index)
        ranked, numbered = _copy(CellGrid, grid), _copy(Queries, queries)
        ranked.index = ranks
        numbered.index = wp.array(np.arange(self._count), dtype=wp.int32, device=device)
        asked.parts = [(ranked, numbered, self._count)]
        counts = search.count(asked, note=True)
        if device.is_cpu:
            lists.start = row_offsets(counts)
            lists.near = self._room(lists.start, refuse)
            given = [numbered, ranked, asked.radius, lists.start, *(asked.notes[0] or ())]
            search.launch_shares(list_kernel, self._count, given, [lists.near], device)
        else:
            lists.start, found, _ = search.fill(asked, counts, refuse)
            lists.near = gathered(self._inverse(ranks, places), found)
        # Where the places are now is computed when it is needed.
        lists.at = None
        if images is None:
            self._turn = None
        else:
            self._turn, lists.inside = images.turn, images.inside
            lists.drift = wp.zeros(self._count, dtype=wp.vec3i, device=device)

    def followed(self, points: "wp.array", farthest: float) -> VerletLists | None:
        """The lists for moved points, vec3d (N,); None if one has moved so far that a neighbor may not be listed.

        Args:
            points: The points as given.
            farthest: Their largest coordinate in magnitude.
        """
        from geokit.points.search import verlet_kernels as kernels

        moved: VerletLists = object.__new__(type(self))
        moved.__dict__.update(self.__dict__)
        now, before, turn, drift, leap = points, self._before, None, None, None
        blur = VANISHING
        if self._images is not None:
            now, turn = self._images.wrapped(points)
            drift = wp.empty(self._count, dtype=wp.vec3i, device=self._device)
            before = wp.empty(self._count, dtype=wp.vec3d, device=self._device)
            leap = wp.empty(self._count, dtype=wp.vec3i, device=self._device)
            has_leapt = wp.zeros(1, dtype=wp.int32, device=self._device)
            given = [now, turn, self._before, self._images.turn, self._lists.cell]
            made = [drift, before, leap, has_leapt]
            launcher.launch(kernels.drift_kernel, self._count, given, made, self._device)
            leap = leap if has_leapt.numpy()[0] else None
            # Coordinates are rounded where they are wrapped, and where images are made.
            blur += ROUNDING * (max(farthest, self._farthest) + self._images.extent)
        allowed = 0.5 * (self._reach * (1.0 - ROUNDING) - self._radius * (1.0 + ROUNDING)) - blur
        if not self._motion(now, before) * (1.0 + ROUNDING) <= allowed:
            return None
        moved._lists = _copy(kernels.VerletLists, self._lists)
        moved._lists.at = None
        moved._points, moved._turn, moved._leap = points, turn, leap
        if drift is not None:
            moved._lists.inside, moved._lists.drift = now, drift
        return moved

    def count(self, radius: float, exclude_self: bool) -> "wp.array":
        """Number of neighbors of each point within a radius that is at most that of the lists, int32 (N,)."""
        from geokit.points.search.verlet_kernels import count_kernel

        counts = wp.empty(self._count, dtype=wp.int32, device=self._device)
        given = [self._placed(), wp.float64(radius * radius), int(exclude_self)]
        launcher.launch(count_kernel, self._count, given, [counts], self._device, grain=GRAIN)
        return counts

    def search(self, radius: float, exclude_self: bool, order: str, single: bool) -> tuple[Any, Any, Any]:
        """offsets (N + 1,), indices (M,) and distance (M,), as :func:`geokit.points.search.radius.fill` gives them.

        In a periodic cell the indices are places, which :meth:`named` and :meth:`shifts` read. ``order`` is "distance";
        else rows ascend by point, then shift.
        """
        from geokit.points.search.verlet_kernels import FILL

        counts = self.count(radius, exclude_self)
        offsets = row_offsets(counts)
        total = int(offsets[self._count :].numpy()[0])
        search.require_room(total, self._count, self._device)
        real = wp.float32 if single and self._device.is_cpu and order != "distance" else wp.float64
        indices = host_pool.empty_warp(total, wp.int32, self._device)
        distance = host_pool.empty_warp(total, real, self._device)
        given = [self._placed(), wp.float64(radius * radius), int(exclude_self), offsets]
        launcher.launch(FILL[real], self._count, given, [indices, distance], self._device, grain=GRAIN)
        return sort_by_distance(offsets, indices, distance) if order == "distance" else (offsets, indices, distance)

    @property
    def has_candidates(self) -> bool:
        """Whether :meth:`candidates` has been called since the lists were made."""
        return bool(self._made)

    def candidates(self, exclude_self: bool) -> tuple[Any, Any, Any]:
        """offsets (N + 1,) and indices (C,) of all candidates, and in a periodic cell their shifts (C, 3).

        They stay the same arrays while the points move, but for shifts of points that were moved by whole cells.
        """
        from geokit.points.search import verlet_kernels as kernels

        if exclude_self not in self._made:
            counts = wp.empty(self._count, dtype=wp.int32, device=self._device)
            given: list[Any] = [self._lists, int(exclude_self)]
            launcher.launch(kernels.candidate_count_kernel, self._count, given, [counts], self._device)
            offsets = row_offsets(counts)
            total = int(offsets[self._count :].numpy()[0])
            turn, each = wp.empty(0, dtype=wp.vec3i, device=self._device), 0
            if self._images is not None:
                turn, each = self._images.turn, 1
            out = [host_pool.empty_warp(total, wp.int32, self._device)]
            out.append(host_pool.empty_warp(3 * total * each, wp.int32, self._device).reshape((-1, 3)))
            launcher.launch(kernels.candidate_kernel, self._count, [*given, turn, offsets], out, self._device)
            self._made[exclude_self] = offsets, out[0], out[1] if each else None
        offsets, indices, shifts = self._made[exclude_self]
        if self._leap is None:
            return offsets, indices, shifts
        moved = wp.empty(shifts.shape, dtype=wp.int32, device=self._device)
        launcher.launch(kernels.leap_kernel, self._count, [offsets, indices, self._leap, shifts], [moved], self._device)
        return offsets, indices, moved

    def named(self, places: "wp.array") -> "wp.array":
        """The point of each neighbor, in its stead."""
        return places if self._images is None else gathered(self._lists.of, places)

    def shifts(self, offsets: "wp.array", places: "wp.array") -> "wp.array":
        """Shift of each neighbor in a periodic cell, int32 (M, 3)."""
        from geokit.points.search.verlet_kernels import shift_kernel

        out = wp.empty((len(places), 3), dtype=wp.int32, device=self._device)
        given = [self._lists, self._turn, offsets, places]
        launcher.launch(shift_kernel, self._count, given, [out], self._device)
        return out

    def _placed(self) -> Any:
        """The lists, with where each place is now."""
        from geokit.points.search import verlet_kernels as kernels

        lists = self._lists
        with self._lock:
            if lists.at is None or len(lists.at) != len(lists.of):
                at = wp.empty(len(lists.of), dtype=wp.vec4d, device=self._device)
                if self._images is None:
                    launcher.launch(kernels.move_kernel, len(at), [self._points, lists.of], [at], self._device)
                else:
                    launcher.launch(kernels.move_images_kernel, len(at), [lists], [at], self._device)
                lists.at = at
        return lists

    def _room(self, offsets: "wp.array", refuse: Callable[[int], None]) -> "wp.array":
        """Room for lists that are read in steps of eight."""
        total = int(offsets[self._count :].numpy()[0])
        refuse(total)
        places = host_pool.empty_warp(total + PADDING, wp.int32, self._device)
        places[total:].zero_()
        return places

    def _motion(self, points: "wp.array", before: "wp.array") -> float:
        """Largest distance between where a point is and was [world]."""
        from geokit.points.search.verlet_kernels import motion_kernel

        if self._device.is_cpu:
            items, rows = -(-self._count // MOTION_SHARE), MOTION_SHARE
            apart, step = rows, 1
        else:
            items = min(self._count, MOTION_THREADS)
            rows, apart, step = -(-self._count // max(items, 1)), 1, items
        squares = wp.empty(items, dtype=wp.float64, device=self._device)
        given = [points, before, rows, apart, step]
        launcher.launch(motion_kernel, items, given, [squares], self._device, grain=2)
        return math.sqrt(squares.numpy().max(initial=0.0))

    def _inverse(self, order: "wp.array", count: int) -> "wp.array":
        from geokit.points.search.verlet_kernels import inverse_kernel

        places = wp.empty(count, dtype=wp.int32, device=self._device)
        launcher.launch(inverse_kernel, count, [order], [places], self._device)
        return places


def _copy(kind: Any, struct: Any) -> Any:
    """A second warp struct with the same arrays."""
    copy = kind()
    for name in kind.vars:
        setattr(copy, name, getattr(struct, name))
    return copy
