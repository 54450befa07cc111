"""Builds the grids of an adaptive field: a band of the coarsest voxels, and the refined cells of each finer level."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geokit.volume._model import SparseVolume
from geokit.volume.adaptive.cells import HALVES, CellLattice, cells_of, keys_of
from geokit.volume.adaptive.level_placement import Placement, placed
from geokit.volume.adaptive.level_sizes import band_lattice
from geokit.volume.band.band import BandShape, build_band, make_band
from geokit.volume.band.fields import grid_head, volume_from_built
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.layout import LEAF_VOXELS
from geokit.volume.tree.device_leaves import build_leaves
from geokit.volume.tree.grid_head import checked_head

__all__ = ["build_band_level", "build_finer_level"]

# Cells of a level whose voxels are found at a time: a gigabyte of keys.
CELLS_AT_A_TIME = 1 << 22


def build_band_level(lattice: CellLattice, name: str) -> SparseVolume:
    """Build level 0, a level set: exact distances at all voxels that interpolation in the zone needs."""
    voxels = band_lattice(lattice)
    shape = BandShape(voxels.reach, voxels.reach, 0.0, lattice.sign)
    band = make_band(voxels, shape)
    return volume_from_built(build_band(band, grid_head(shape, voxels, name)), {})


def build_finer_level(lattice: CellLattice, parents: NDArray[np.int64], background: float, name: str) -> SparseVolume:
    """Build a level above 0: exact distances at the voxels of the halves of refined cells; only these are active.

    Args:
        lattice: The lattice of this level.
        parents: Keys of the refined cells of the next coarser level.
        background: Value of all other voxels.
        name: Name of the grid.
    """
    cells = cells_of(parents)
    placement = placed(cells)
    voxels = _voxels_of(cells, placement)
    distance, _ = lattice.distances(voxels + placement.start)
    tiles, rows = np.unique(keys_of(voxels >> 3), return_inverse=True)
    slots = (voxels & 7) @ np.array([64, 8, 1])
    values = np.full((len(tiles), LEAF_VOXELS), background, np.float32)
    active = np.zeros((len(tiles), LEAF_VOXELS), bool)
    values[rows.reshape(-1), slots] = distance
    active[rows.reshape(-1), slots] = True
    transform = np.diag([lattice.size] * 3 + [1.0])
    transform[:3, 3] = lattice.positions(placement.start)
    head = checked_head("float", background, background, transform, name, "unknown")
    buffer = build_leaves(head, (8 * cells_of(tiles)).astype(np.int32), values, active, signed=False)
    return SparseVolume(buffer, info_of(buffer, {}))


def _voxels_of(cells: NDArray[np.int64], placement: Placement) -> NDArray[np.int64]:
    """Unique voxels of the halves of cells, in the index space of the grid."""
    keys = [
        np.unique(keys_of(((2 * cells[i : i + CELLS_AT_A_TIME])[:, None] + HALVES - placement.start).reshape(-1, 3)))
        for i in range(0, len(cells), CELLS_AT_A_TIME)
    ]
    return cells_of(np.unique(np.concatenate(keys)))
