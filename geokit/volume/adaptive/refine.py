"""Refines cells around a surface until their interpolants keep an error limit: a tree of cells.

The voxels of a level are placed in its index space so that they fill few leaves and few nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory import available_memory
from geokit.volume.adaptive.cells import CORNERS, CellLattice, contains, examine, near
from geokit.volume.adaptive.storage import ACCEPTED_SHARE, Storage
from geokit.volume.band.place_keys import keys_of, places_of
from geokit.volume.nanovdb.layout import layout_of

# Bytes of a cell while it is examined: its key, its halves' keys, the distances at its voxels.
CELL_BYTES = 1000
# The sharpest creases exceed the limit in cells of 1.5 times its size, and spikes in slightly smaller ones. If cells of
# this share of the accepted error exceed it, the distance itself jumps: beside the border of an open mesh.
SMALLEST_SHARE = 0.25
FLOAT = layout_of(1, "float grid")
LEAF, LOWER, UPPER = 8, 128, 4096
# Most places for which rows are counted in a table of marks, 64 MiB; beyond this they are sorted.
LARGEST_TABLE = 1 << 26


class Placement(NamedTuple):
    """Index space of a level.

    Attributes:
        start: Index of the lattice that becomes index 0 of the grid, shape (3,); no index of the grid is negative.
        byte_count: Size of the grid.
    """

    start: NDArray[np.int64]
    byte_count: int


@dataclass
class Refinement:
    """The cells of level 0 around a surface, and the refined cells of each level.

    Attributes:
        lattice: Lattice of level 0.
        storage: Order and codec; cells with a larger error than it accepts at their level are refined.
        level_limit: Most levels.
        refined: Sorted keys of the refined cells of each level that has any.
        worst: Largest error [world] of a cell that could not be refined; 0 if there is none.
        errors: If not None, the errors found in the cells of each level.
        goes_on: Asked before each finer level is examined, with its number; the exploration ends if it says False.
    """

    lattice: CellLattice
    storage: Storage
    level_limit: int
    refined: list[NDArray[np.int64]] = field(default_factory=list)
    worst: float = 0.0
    errors: list[NDArray[np.float64]] | None = None
    goes_on: Callable[[int], bool] = lambda _: True

    @property
    def level_count(self) -> int:
        """Number of levels."""
        return 1 + len(self.refined)

    def lattice_of(self, level: int) -> CellLattice:
        """The cells of a level."""
        return replace(self.lattice, size=self.lattice.size / 2**level)

    def limit_of(self, level: int) -> float:
        """Cells of a level with a larger error [world] are refined."""
        return self.storage.limit(self.lattice.size / 2**level)

    def explore(self, level: int, cells: NDArray[np.int64]) -> None:
        """Examine cells of a level, refine those that exceed the limit, and go on with their halves.

        Raises:
            DeviceMemoryError: There are more cells than memory can hold.
        """
        what = f"tolerance: {len(cells)} cells of size {self.lattice_of(level).size:g} need"
        available_memory.require_room(len(cells) * CELL_BYTES, what, "use a larger tolerance")
        limit = self.limit_of(level)
        errors = examine(self.lattice_of(level), cells, limit, self.storage.order)
        if self.errors is not None:
            self.errors.extend([np.zeros(0)] * (level + 1 - len(self.errors)))
            self.errors[level] = np.concatenate([self.errors[level], errors])
        missed = errors > limit
        if missed.any():
            self.hand_on(
                level,
                cells[missed],
                float(errors.max()) + self.storage.change_of_interpolant(self.lattice_of(level).size),
            )

    def hand_on(self, level: int, cells: NDArray[np.int64], error: float) -> None:
        """Refine cells of a level, whose largest error is ``error``, by their halves in the next level."""
        smallest = SMALLEST_SHARE * ACCEPTED_SHARE * self.storage.tolerance
        if level + 1 >= self.level_limit or self.lattice_of(level + 1).size < smallest:
            self.worst = max(self.worst, error)
            return
        if level == len(self.refined):
            self.refined.append(np.zeros(0, np.int64))
        keys = np.unique(keys_of(cells))
        keys = keys[~contains(self.refined[level], keys)]
        if not len(keys):
            return
        self.refined[level] = np.union1d(self.refined[level], keys)
        halves = (2 * places_of(keys)[:, None] + CORNERS).reshape(-1, 3)
        if self.goes_on(level + 1):
            self.explore(level + 1, halves[near(self.lattice_of(level + 1), halves)])

    def correct(self, points: NDArray[np.float64], errors: NDArray[np.float64]) -> None:
        """Refine the finest cells around points whose errors were found to exceed the limit."""
        level, cell = self.locate(points)
        for each in np.unique(level):
            here = level == each
            self.hand_on(int(each), cell[here], float(errors[here].max()))

    def locate(self, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Level (N,) and cell (N, 3) of the finest cell around each point near the surface."""
        index = (points - self.lattice.origin) / self.lattice.size
        cell = np.floor(index).astype(np.int64)
        fraction = index - cell
        level = np.zeros(len(points), np.int64)
        rows = np.arange(len(points))
        for depth, refined in enumerate(self.refined):
            rows = rows[contains(refined, keys_of(cell[rows]))]
            upper = fraction[rows] >= 0.5
            cell[rows] = 2 * cell[rows] + upper
            fraction[rows] = 2.0 * fraction[rows] - upper
            level[rows] = depth + 1
        return level, cell

    def placements(self) -> list[Placement]:
        """Placements of the voxels of levels 1, 2, ..."""
        return [self.placement(level) for level in range(1, self.level_count)]

    def placement(self, level: int) -> Placement:
        """Placement of the voxels of a level from 1 on."""
        leaf_bytes = self.storage.leaf_bytes(self.lattice_of(level).size)
        return placed(places_of(self.refined[level - 1]), self.storage.halves, leaf_bytes)


def placed(parents: NDArray[np.int64], halves: NDArray[np.int64], leaf_bytes: int) -> Placement:
    """Placement of the voxels of the halves of refined cells (N, 3) of the next coarser level.

    ``halves`` are the voxels along an axis that belong to a refined cell, relative to its first one. A leaf is wider
    than these, so the corners of their box touch the same leaves.

    The phase of the leaves is one of 8 x 8 x 8. A pass over the axes tries those that differ from the best so far along
    one axis, and then does the same for the phase of the lower nodes.
    """
    corners = np.stack(np.meshgrid(*[[0, halves[-1] - halves[0]]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    low = 2 * parents.min(axis=0) + halves[0]
    local = (2 * parents + halves[0] - low)[:, None] + corners
    phase = _descend(lambda phase: _count(((local + phase) >> 3).reshape(-1, 3)), LEAF)
    tiles = np.unique((local + phase).reshape(-1, 3) >> 3, axis=0)
    phase = phase + LEAF * _descend(lambda nodes: _count((tiles + nodes) >> 4), LOWER // LEAF)
    tiles = np.unique((local + phase).reshape(-1, 3) >> 3, axis=0)
    return Placement(low - phase, grid_bytes(tiles, leaf_bytes))


def grid_bytes(tiles: NDArray[np.int64], leaf_bytes: int = FLOAT.leaf_size) -> int:
    """Bytes of a float or quantized grid with the given unique leaves, (L, 3) in units of leaves."""
    lower = np.unique(tiles >> 4, axis=0)
    upper = np.unique(lower >> 5, axis=0)
    nodes = len(tiles) * leaf_bytes + len(lower) * FLOAT.lower_size
    return nodes + len(upper) * (FLOAT.upper_size + FLOAT.root_tile_size)


def _descend(count, options: int) -> NDArray[np.int64]:
    """The phase (3,) with the least count that one pass over the axes finds."""
    best = np.zeros(3, np.int64)
    least = count(best)
    for axis in range(3):
        for value in range(1, options):
            tried = best.copy()
            tried[axis] = value
            found = count(tried)
            if found < least:
                best, least = tried, found
    return best


def _count(places: NDArray[np.int64]) -> int:
    """Number of unique rows of nonnegative integers."""
    size = places.max(axis=0) + 1
    if np.prod(size.astype(np.float64)) > LARGEST_TABLE:
        return len(np.unique(keys_of(places)))
    table = np.zeros(int(np.prod(size)), bool)
    table[(places[:, 0] * size[1] + places[:, 1]) * size[2] + places[:, 2]] = True
    return int(np.count_nonzero(table))
