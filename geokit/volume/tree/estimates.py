"""What a grid holds, counted once from its masks, and what operations on it need at least, asked before they start."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory import available_memory
from geokit.core.memory.needs import require_free
from geokit.errors import InputError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.layout import LEAF_VOXELS
from geokit.volume.nanovdb.nodes import grid_nodes, root_origins
from geokit.volume.nanovdb.upload import above_leaves

# Most leaves from the origin along an axis: voxel indices are int32.
FARTHEST_TILE = 1 << 28
# Leaves that OpenVDB's tools may add around a grid along an axis, and count past with int32.
OPENVDB_MARGIN = 1 << 10
# OpenVDB's tree, and its second buffer or the result (7.4 to 8.7 kB a leaf measured); a leaf has 100 bytes beside its
# values.
OPENVDB_COPIES, OPENVDB_LEAF_BYTES = 1.7, 100
# Where a grid's header states its number of leaves, the size of a leaf of floats, and that of the smallest leaf.
LEAF_COUNT_AT, FLOAT_LEAF_BYTES, LEAST_LEAF_BYTES = 704, 2144, 96
# Needs up to this many bytes are not checked: to ask for the free memory takes 20 us.
UNCHECKED_BYTES = 1 << 24
# Volume of a ball of radius 1.
UNIT_BALL = 4.0 / 3.0 * np.pi


class Counts(NamedTuple):
    """What a grid holds, by its masks rather than by what its headers say.

    Attributes:
        leaves: Number of leaves.
        lower_tiles: Active tiles of 8^3 voxels.
        upper_tiles: Active tiles of 128^3 voxels.
        root_tiles: Active tiles of 4096^3 voxels.
        box: First and last leaf of the upper nodes and root tiles [leaves], (2, 3) int64; None if there are none.
    """

    leaves: int
    lower_tiles: int
    upper_tiles: int
    root_tiles: int
    box: NDArray[np.int64] | None

    @property
    def has_tiles(self) -> bool:
        """Whether a tile is active."""
        return bool(self.lower_tiles or self.upper_tiles or self.root_tiles)


def leaf_count(volume: SparseVolume) -> int:
    """Number of leaves by the grid's header; by its size where it is on a GPU only. For estimates."""
    if "nanovdb" not in volume.__dict__:
        return volume.info.byte_count // FLOAT_LEAF_BYTES
    stated = int(volume.nanovdb[LEAF_COUNT_AT : LEAF_COUNT_AT + 4].view(np.uint32)[0])
    return min(stated, len(volume.nanovdb) // LEAST_LEAF_BYTES)


def counts_of(volume: SparseVolume) -> Counts:
    """Count the leaves and active tiles of a grid, once for each volume.

    Raises:
        FileFormatError, UnsupportedGridError: The buffer is not a valid grid.
    """
    return volume._cache.find("counts", lambda: _counted(volume))


def _counted(volume: SparseVolume) -> Counts:
    check_volume(volume)
    grid = grid_nodes(above_leaves(volume))
    lower, upper = (
        sum(int(np.unpackbits(part.tile_mask[part.tile_mask != 0]).sum(dtype=np.int64)) for _, part in level.parts())
        for level in (grid.lower, grid.upper)
    )
    table = grid.table
    is_active = (table["child"] == 0) & (table["state"] != 0)
    corners = root_origins(table["key"][is_active | (table["child"] != 0)]).astype(np.int64) >> 3
    box = np.stack([corners.min(axis=0), corners.max(axis=0) + 511]) if len(corners) else None
    return Counts(grid.leaf.count, lower, upper, int(is_active.sum()), box)


def least_leaves(voxels: int, reach: float) -> float:
    """Fewest leaves that ``voxels`` voxels and all others within ``reach`` [voxels] of them can take.

    Source:
        Brunn-Minkowski: the volume of a body and all within a distance is least for a ball.
    """
    if not voxels:
        return 0.0
    with np.errstate(over="ignore"):
        return float((np.cbrt(voxels) + UNIT_BALL ** (1.0 / 3.0) * np.float64(reach)) ** 3 / LEAF_VOXELS)


def require_host_room(need: int, what: str) -> None:
    """Check that ``need`` bytes are free on the host.

    Raises:
        DeviceMemoryError: They are not; the message starts with ``what`` and states the estimate.
    """
    if need > UNCHECKED_BYTES:
        available_memory.require_room(need, f"{what} need", "clip it, or resample it at a larger voxel_size")


def require_places(tiles: NDArray[np.int32], name: str) -> None:
    """Check that all voxels of leaves at ``tiles`` (N, 3) [leaves] have int32 indices.

    Raises:
        InputError: They do not.
    """
    if len(tiles) and (tiles.min() < -FARTHEST_TILE or tiles.max() >= FARTHEST_TILE):
        raise InputError(
            f"volume: grid {name!r} would reach voxels beyond index 2^31; move it closer to index 0, or clip it"
        )


def require_openvdb_room(volume: SparseVolume) -> None:
    """Check that OpenVDB's tools can walk a grid and hold it: its place and its size.

    Raises:
        InputError: The grid lies within 8,192 voxels of the last int32 index.
        DeviceMemoryError: Tree and result need more memory than there is.
        FileFormatError, UnsupportedGridError: The buffer is not a valid grid.
    """
    counts, name = counts_of(volume), volume.info.name
    if counts.box is not None and np.abs(2 * counts.box + 1).max() >= 2 * (FARTHEST_TILE - OPENVDB_MARGIN):
        raise InputError(
            f"volume: grid {name!r} reaches voxels next to index 2^31, where OpenVDB's indices overflow; move it "
            "closer to index 0"
        )
    leaf_bytes = LEAF_VOXELS * (8 if volume.info.grid_type == "double" else 4) + OPENVDB_LEAF_BYTES
    need = int(OPENVDB_COPIES * (counts.leaves * leaf_bytes + volume.info.byte_count))
    what = f"volume: OpenVDB's copies of the {counts.leaves:,} leaves of grid {name!r}"
    require_host_room(need, what)
    require_free(need, what, always=True)  # OpenVDB ends the process where it gets no memory
