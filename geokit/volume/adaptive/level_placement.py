"""Where the voxels of a level go in its index space, so that they fill few leaves and few nodes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume.adaptive.cells import keys_of
from geokit.volume.nanovdb.layout import layout_of

__all__ = ["FLOAT", "LEAF", "Placement", "float_grid_bytes", "placed"]

FLOAT = layout_of(1, "float grid")
LEAF, LOWER, UPPER = 8, 128, 4096
# Places of a table that is marked rather than sorted: 64 MiB.
LARGEST_TABLE = 1 << 26
# Corners of the 3^3 voxels of a cell's halves: as a leaf is wider than they are, they touch all leaves that those do.
EXTREMES = 2 * np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)


class Placement(NamedTuple):
    """Index space of a level.

    Attributes:
        start: What is taken off an index of the lattice to give one of the grid, shape (3,); none is negative then.
        byte_count: Size of the grid.
    """

    start: NDArray[np.int64]
    byte_count: int


def placed(parents: NDArray[np.int64]) -> Placement:
    """Placement of the voxels of the halves of cells, shape (N, 3), of the level before.

    One leaf begins where it begins for all: of the 8 x 8 x 8 ways those are tried that differ from the best so far
    along one axis, and in the same way the lower nodes.
    """
    low = 2 * parents.min(axis=0)
    local = (2 * parents - low)[:, None] + EXTREMES
    phase = _descend(lambda phase: _leaf_count(local, phase), LEAF)
    tiles = np.unique((local + phase).reshape(-1, 3) >> 3, axis=0)
    phase = phase + LEAF * _descend(lambda nodes: _node_count(tiles + nodes), LOWER // LEAF)
    tiles = np.unique((local + phase).reshape(-1, 3) >> 3, axis=0)
    return Placement(low - phase, float_grid_bytes(tiles))


def float_grid_bytes(tiles: NDArray[np.int64]) -> int:
    """Bytes of a float grid with such leaves, in units of leaves, shape (L, 3), each once."""
    lower = np.unique(tiles >> 4, axis=0)
    upper = np.unique(lower >> 5, axis=0)
    nodes = len(tiles) * FLOAT.leaf_size + len(lower) * FLOAT.lower_size
    return nodes + len(upper) * (FLOAT.upper_size + FLOAT.root_tile_size)


def _descend(count, options: int) -> NDArray[np.int64]:
    """The phase (3,) of least count that one pass over the axes finds."""
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


def _leaf_count(voxels: NDArray[np.int64], phase: NDArray[np.int64]) -> int:
    return _count(((voxels + phase) >> 3).reshape(-1, 3))


def _node_count(tiles: NDArray[np.int64]) -> int:
    return _count(tiles >> 4)


def _count(places: NDArray[np.int64]) -> int:
    """Number of different rows, which are not negative."""
    size = places.max(axis=0) + 1
    if np.prod(size.astype(np.float64)) > LARGEST_TABLE:
        return len(np.unique(keys_of(places)))
    table = np.zeros(int(np.prod(size)), bool)
    table[(places[:, 0] * size[1] + places[:, 1]) * size[2] + places[:, 2]] = True
    return int(np.count_nonzero(table))
