"""Places the voxels of a level in its index space so that they fill few leaves and few nodes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume.band.place_keys import keys_of
from geokit.volume.nanovdb.layout import layout_of

__all__ = ["FLOAT", "LEAF", "Placement", "grid_bytes", "placed"]

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
