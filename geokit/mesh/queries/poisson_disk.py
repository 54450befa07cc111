"""Poisson-disk sets by dart throwing: points of a surface with a minimum distance from each other."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory import available_memory
from geokit.core.memory.host_array import HostArray
from geokit.errors import DeviceMemoryError, InputError

# Draws that many uniform samples: triangle_id, barycentric, and positions.
Draw = Callable[[int], tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]]

# Points in a saturated random packing of discs of diameter r on an area A: 0.547 A / (pi r^2 / 4).
SATURATED_SHARE = 0.547 / (math.pi / 4.0)
# Candidates per point if the count is given: 12 give a radius 4% smaller, 50 one that is 2% larger (on a sphere).
CANDIDATES_PER_POINT = 25
# The first radius, as a share of the one at which a saturated packing has the wanted count; smaller radii fill the
# rest. With 0.9 the count is reached before the packing is saturated; with 1.1 gaps remain that no later point fills
# well. Both end at radii 3% smaller.
FIRST_RADIUS = 0.95
# Each radius is this share of the previous one: the last one is at most 1% too small.
RADIUS_STEP = 0.99
# If the radius is given, candidates come in passes, with this many for each point taken so far, ...
CANDIDATES_PER_PASS = 4
# ... until a pass adds a smaller share than this: then less than about 0.13% of the area has room for another point.
LAST_PASS_SHARE = 0.005
# Candidates drawn at once; bounds the memory of rejected ones.
MOST_CANDIDATES = 1 << 20
FEWEST_CANDIDATES = 1 << 10
# Cells along the longest axis: their numbers stay well inside int32.
MOST_CELLS = 2.0**29
# The cells that a ball touches are found from rounded offsets: 4 roundings of the extent, and 4 of the radius.
REACH_ROUNDING = 1e-15
# A point, its links, its triangle and its weights, and the same again while arrays grow and are returned.
BYTES_PER_POINT = 400
# Peak memory of a draw per sample: three random numbers, three corners, differences, weights, position.
BYTES_PER_CANDIDATE = 240
MOST_POINTS = 2**31 - 1


class _Darts:
    """The points taken so far, in scaled coordinates, and the hash grid that finds those near a candidate."""

    def __init__(self, lower: NDArray[np.float64], extent: float) -> None:
        self.count = 0
        self.points = np.empty((0, 3))
        self._lower, self._extent = lower, extent
        self._device = launcher.resolve_device("cpu")
        self._grid: Any = None
        self._radius, self._buckets = math.inf, 0

    def throw(
        self, candidates: NDArray[np.float64], nearest: NDArray[np.float64], radius: float, wanted: int
    ) -> NDArray[np.int32]:
        """Take candidates until there are ``wanted`` points; returns the rows of those taken, in their order."""
        from geokit.mesh.queries.poisson_disk_kernels import throw_kernel

        before = self.count
        self._make_room(min(wanted, before + len(candidates)), radius)
        taken = np.empty(len(self.points), np.int32)
        count = np.array([before], np.int32)
        reach = radius * (1.0 + REACH_ROUNDING) + self._extent * REACH_ROUNDING
        inputs = [HostArray(candidates), self._grid, wp.float64(radius * radius), wp.float64(reach), wanted]
        launcher.launch(throw_kernel, 1, inputs, [HostArray(nearest), HostArray(taken), HostArray(count)], self._device)
        self.count = int(count[0])
        return taken[before : self.count]

    def _make_room(self, most: int, radius: float) -> None:
        """Provide arrays for ``most`` points, and cells that suit the radius and the number of points."""
        from geokit.mesh.queries.poisson_disk_kernels import DartGrid, insert_kernel

        # A cell much longer than the radius holds many points, and so does a chain that many cells share.
        suits = self._grid is not None and radius >= 0.5 * self._radius and self.count <= self._buckets
        if most <= len(self.points) and suits:
            return
        if most > len(self.points):
            grown = np.empty((max(most, 2 * self.count), 3))
            grown[: self.count] = self.points[: self.count]
            self.points = grown
        self._radius, self._buckets = radius, 1 << max(10, (2 * self.count).bit_length())
        self._buckets = max(self._buckets, 1 << min(most, MOST_CANDIDATES).bit_length())
        grid = DartGrid()
        self._kept = [np.full(self._buckets, -1, np.int32), np.empty(len(self.points), np.int32)]
        grid.points, grid.head, grid.next = HostArray(self.points).warp, *(HostArray(a).warp for a in self._kept)
        grid.lower = wp.vec3d(*map(float, self._lower))
        grid.cells_per_unit = wp.float64(1.0 / max(2.0 * radius, self._extent / MOST_CELLS))
        grid.bucket_mask = wp.int64(self._buckets - 1)
        self._grid = grid
        launcher.launch(insert_kernel, 1, [self.count, grid], [], self._device)


def throw_radius(
    draw: Draw, radius: float, scale: float, area: float, lower: NDArray[np.float64], extent: float, label: str
) -> tuple[list[NDArray[Any]], float]:
    """Points at least ``radius`` apart, until there is hardly room for another.

    Args:
        draw: Draws uniform samples.
        radius: Minimum distance [world].
        scale: Power of two that brings coordinates to unit size, so that squares neither overflow nor vanish.
        area: Area of the surface [scaled].
        lower: Lower corner of its bounding box [scaled].
        extent: Longest edge of its bounding box [scaled].
        label: Name of the mesh in messages.
    Returns:
        The arrays of ``draw`` for the points that were taken; the radius.
    Raises:
        DeviceMemoryError: The points would not fit in memory.
    """
    scaled = radius * scale
    room = int(min(MOST_POINTS, available_memory.available_host() // BYTES_PER_POINT))
    # If the square of the radius underflows to zero, a count that exceeds any memory.
    expected = SATURATED_SHARE * area / scaled / scaled if scaled * scaled > 0.0 else 1e300
    if expected > room:
        _refuse_radius(label, radius, expected, room, math.sqrt(SATURATED_SHARE * area / max(room, 1)) / scale)
    darts = _Darts(lower, extent)
    kept: list[tuple[NDArray[Any], ...]] = []
    while True:
        start, thrown = darts.count, 0
        target = max(CANDIDATES_PER_PASS * max(start, int(expected) // 4), FEWEST_CANDIDATES)
        while thrown < target:
            rows = draw(min(target - thrown, MOST_CANDIDATES))
            nearest = np.full(len(rows[0]), math.inf)
            taken = darts.throw(rows[-1] * scale, nearest, scaled, MOST_POINTS)
            kept.append(tuple(column[taken] for column in rows))
            thrown += len(rows[0])
            if darts.count > room:
                _refuse_radius(label, radius, darts.count, room, None)
        if darts.count - start <= LAST_PASS_SHARE * darts.count:
            return [np.concatenate(columns) for columns in zip(*kept, strict=True)], radius


def _refuse_radius(label: str, radius: float, expected: float, room: int, fitting: float | None) -> None:
    remedy = f"use a radius of {fitting:.3g} or more" if fitting else "use a larger radius"
    raise DeviceMemoryError(
        f"radius: {label} has room for more than {expected:.3g} points {radius:g} apart, "
        f"and this machine's memory for {room}; {remedy}"
    )


def throw_count(
    draw: Draw, count: int, scale: float, area: float, lower: NDArray[np.float64], extent: float, label: str
) -> tuple[list[NDArray[Any]], float]:
    """``count`` points as far apart as dart throwing with shrinking radii places them.

    The arguments are those of :func:`throw_radius`, with ``count``, the number of points, for ``radius``.

    Returns:
        The arrays of ``draw`` for the points that were taken; the last radius [world], their minimum distance.
    Raises:
        InputError: After rounding, the coordinates have fewer different points than ``count``.
        DeviceMemoryError: The candidates would not fit in memory.
    """
    room = available_memory.available_host() // (BYTES_PER_CANDIDATE * CANDIDATES_PER_POINT)
    if count > min(room, MOST_POINTS // CANDIDATES_PER_POINT):
        raise DeviceMemoryError(
            f"count: {count} points are chosen among {CANDIDATES_PER_POINT} times as many, and this machine's memory "
            f"holds candidates for {room}; ask for fewer, or give a radius"
        )
    rows = draw(CANDIDATES_PER_POINT * count)
    candidates = rows[-1] * scale
    nearest = np.full(len(candidates), math.inf)
    darts = _Darts(lower, extent)
    radius = FIRST_RADIUS * math.sqrt(SATURATED_SHARE * area / count)
    kept = [darts.throw(candidates, nearest, radius, count)]
    while darts.count < count:
        # No candidate has room at a radius above the largest remaining distance.
        furthest = math.sqrt(float(nearest.max(initial=0.0)))
        radius = min(radius * RADIUS_STEP, furthest)
        if radius * radius == 0.0:
            raise InputError(
                f"count: float64 has only {darts.count} points of {label} that differ, of {count}; "
                "move the mesh next to the origin or ask for fewer"
            )
        kept.append(darts.throw(candidates, nearest, radius, count))
    taken = np.concatenate(kept)
    return [column[taken] for column in rows], radius / scale
