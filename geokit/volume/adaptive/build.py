"""Builds the grids of an adaptive field: a band of the coarsest voxels, and the refined cells of each finer level."""

from __future__ import annotations

import numpy as np

from geokit.volume.adaptive.cells import CellLattice, spread_keys
from geokit.volume.adaptive.level_sizes import band_lattice
from geokit.volume.adaptive.refine import Refinement
from geokit.volume.adaptive.storage import Storage
from geokit.volume.band.band import BandShape, build_band, make_band
from geokit.volume.band.fields import grid_head, volume_from_built
from geokit.volume.band.place_keys import keys_of, places_of
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.layout import LEAF_VOXELS
from geokit.volume.nanovdb.provenance import ORDER, with_more
from geokit.volume.retyped.quantize import quantize
from geokit.volume.tree.device_leaves import build_leaves
from geokit.volume.tree.grid_head import checked_head


def build_band_level(lattice: CellLattice, storage: Storage, name: str) -> SparseVolume:
    """Build level 0, a level set: exact distances at all voxels that interpolation in the zone needs."""
    voxels = band_lattice(lattice, storage.order)
    shape = BandShape(voxels.reach, voxels.reach, 0.0, lattice.sign)
    band = make_band(voxels, shape)
    return _stored(volume_from_built(build_band(band, grid_head(shape, voxels, name)), {}), storage, lattice.size)


def build_finer_level(tree: Refinement, level: int, background: float, name: str) -> SparseVolume:
    """Build a level above 0: exact distances at the voxels that halves of refined cells read; only these are active.

    Args:
        tree: The refined cells.
        level: Number of the level.
        background: Value outside the leaves.
        name: Name of the grid.
    """
    lattice, placement, storage = tree.lattice_of(level), tree.placement(level), tree.storage
    keys = spread_keys(keys_of(2 * places_of(tree.refined[level - 1]) - placement.start), storage.halves)
    voxels = places_of(keys)
    distance, _ = lattice.distances(voxels + placement.start)
    tiles, rows = np.unique(keys_of(voxels >> 3), return_inverse=True)
    slots = (voxels & 7) @ np.array([64, 8, 1])
    values = np.full((len(tiles), LEAF_VOXELS), background, np.float32)
    if storage.codec_of(lattice.size) != "float":
        # Codes span all values of a leaf, so the others must lie among the active ones.
        values[:] = distance[np.unique(rows, return_index=True)[1]][:, None]
    active = np.zeros((len(tiles), LEAF_VOXELS), bool)
    values[rows.reshape(-1), slots] = distance
    active[rows.reshape(-1), slots] = True
    transform = np.diag([lattice.size] * 3 + [1.0])
    transform[:3, 3] = lattice.positions(placement.start)
    head = checked_head("float", background, background, transform, name, "unknown")
    buffer = build_leaves(head, (8 * places_of(tiles)).astype(np.int32), values, active, signed=False)
    return _stored(SparseVolume(buffer, info_of(buffer, {})), storage, lattice.size)


def _stored(volume: SparseVolume, storage: Storage, size: float) -> SparseVolume:
    codec = storage.codec_of(size)
    if codec != "float":
        volume = quantize(volume, codec, tolerance=storage.change(size) if codec == "fpn" else None)
    return with_more(volume, {ORDER: storage.order})
