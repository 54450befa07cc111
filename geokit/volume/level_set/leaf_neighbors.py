"""The leaves of a level set as rows with links to their neighbors, on a device; rows can be added."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory import available_memory
from geokit.errors import DeviceMemoryError, InputError
from geokit.volume.band.place_keys import KEY_BITS, keys_of
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.types import QUANTIZED
from geokit.volume.tree.estimates import require_places
from geokit.volume.tree.leaves import Leaves, leaves_of, voxelized

# Most leaves: elements are numbered by int32.
MOST_LEAVES = (1 << 31) // 512 - 1
# Bytes of a row while distances are computed: value, distance, slope, result, its feature twice, bits, and the grid.
BYTES_PER_ROW = 512 * (8 + 8 + 4 + 4 + 2 * 4) + 8 * 64 + 2144
# All 27 places around a leaf, itself in the middle.
AROUND = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1) - 1


class LinkedLeaves:
    """Rows of leaves.

    Args:
        volume: Level set of float, double or quantized values.
        isovalue: Value of the surface [world]; it is subtracted from the values.
        device: Device of the rows.

    Attributes:
        volume: The level set (float if that is quantized), and its id on the device as ``handle``.
        tiles: Coordinates in units of leaves, (T, 3) int32.
        on_device: ``tiles`` on the device, (T,) of vec3i.
        beside: Row of each of the 27 places around a leaf, or OUTSIDE or INSIDE if it has no row, (T, 27).
        inside: Bit masks of the voxels with a negative value, (8 T,) of uint64.
        values: Values of the first R rows, which the volume had before any was added, (512 R,) of float64.
        active: Bit masks of the active voxels of the same rows, (8 R,) of uint64.
    """

    tiles: NDArray[np.int32]
    on_device: "wp.array"
    beside: "wp.array"
    active: "wp.array"
    inside: "wp.array"

    def __init__(self, volume: SparseVolume, isovalue: float, device: "wp.Device") -> None:
        from geokit.volume.level_set import leaf_neighbors_kernels as kernels

        source = voxelized(volume) if volume.info.grid_type in QUANTIZED else volume
        leaves = leaves_of(source)
        self._begin(source, leaves, isovalue, device)
        count = len(self.tiles)
        values, inside = self._read()
        open_sides = wp.zeros(27 * count, dtype=wp.uint8, device=device)
        launcher.launch(kernels.open_sides_kernel, 27 * count, [inside, self.beside], [open_sides], device)
        row, side = np.nonzero(open_sides.numpy().reshape(-1, 27))
        if len(row):
            # Where the surface runs along the border between a leaf and a tile, the tile gets a row of its own.
            self.tiles = np.concatenate(
                [self.tiles, np.unique(self.tiles[row] + AROUND[side], axis=0).astype(np.int32)]
            )
            self._link()
            values, inside = self._read()
        masks = np.zeros((len(self.tiles), 64), np.uint8)
        masks[:count] = leaves.masks
        self.values, self.inside = values, inside
        self.active = wp.array(masks.reshape(-1).view(np.uint64), dtype=wp.uint64, device=device)

    @classmethod
    def bare(cls, volume: SparseVolume, leaves: Leaves, device: "wp.Device") -> LinkedLeaves:
        """Rows without values for leaves of a grid of any type; no voxel counts as inside."""
        made = cls.__new__(cls)
        made._begin(volume, leaves, -np.inf, device)
        masks = np.ascontiguousarray(leaves.masks).reshape(-1).view(np.uint64)
        made.active = wp.array(masks, dtype=wp.uint64, device=device)
        made.inside = wp.zeros(8 * len(made.tiles), dtype=wp.uint64, device=device)
        return made

    def _begin(self, volume: SparseVolume, leaves: Leaves, isovalue: float, device: "wp.Device") -> None:
        self.device = device
        self.volume = volume
        self.handle = wp.uint64(volume.id(device))
        self._isovalue = wp.float64(isovalue)
        self.tiles = leaves.origins >> 3
        self._link()

    def activate_beside_zeros(self, rounding: float) -> None:
        """Let voxels next to an active one with the value 0 count as active: they are a voxel away from the surface.

        Args:
            rounding: Largest value that counts as 0 [world].
        """
        from geokit.volume.level_set.leaf_neighbors_kernels import beside_zeros_kernel

        wider = wp.empty_like(self.active)
        inputs = [self.values, self._isovalue, wp.float64(rounding), self.active, self.beside]
        launcher.launch(beside_zeros_kernel, len(wider), inputs, [wider], self.device)
        self.active = wider

    def add(self, tiles: NDArray[np.int32]) -> None:
        """Add rows for new leaves; they take the side of the tiles in their places."""
        from geokit.volume.level_set.leaf_neighbors_kernels import tile_side_kernel

        if not len(tiles):
            return
        start = len(self.tiles)
        self.tiles = np.concatenate([self.tiles, tiles])
        self._link()
        inside = wp.empty(8 * len(self.tiles), dtype=wp.uint64, device=self.device)
        wp.copy(inside, self.inside, count=8 * start)
        inputs = [self.handle, self.on_device, start, self._isovalue]
        launcher.launch(tile_side_kernel, len(tiles), inputs, [inside], self.device)
        self.inside = inside

    def extended(self, array: "wp.array", per_row: int, fill: int) -> "wp.array":
        """The array, with ``per_row`` elements per row, extended by ``fill`` to all rows."""
        wanted = per_row * len(self.tiles)
        if len(array) == wanted:
            return array
        longer = wp.full(wanted, fill, dtype=array.dtype, device=self.device)
        wp.copy(longer, array, count=len(array))
        return longer

    def within(self, words: "wp.array", reach: int) -> NDArray[np.int32]:
        """Unique coordinates of leaves without a row that are within ``reach`` [voxels] of the voxels set in words."""
        from geokit.volume.level_set.feature_transform_kernels import reached_box_kernel

        count = len(self.tiles)
        boxes = wp.empty((count, 6), dtype=wp.int32, device=self.device)
        launcher.launch(reached_box_kernel, count, [words], [boxes], self.device, grain=64)
        box = boxes.numpy().reshape(-1, 2, 3)
        low, high = box[:, 0] < reach, box[:, 1] + reach > 7
        wanted = np.repeat(box[:, 1, :1] >= 0, len(AROUND), axis=1)
        for axis in range(3):
            wanted &= (AROUND[:, axis] >= 0) | low[:, axis, None]
            wanted &= (AROUND[:, axis] <= 0) | high[:, axis, None]
        return self._around(*np.nonzero(wanted))

    def _around(self, rows: NDArray[np.int64], sides: NDArray[np.int64]) -> NDArray[np.int32]:
        """Unique coordinates of the neighbors of ``rows`` that have no row yet; ``sides`` number them from 0 to 26."""
        beside = self.beside.numpy()
        missing = beside[rows, sides] < 0
        wanted = self.tiles[rows[missing]] + AROUND[sides[missing]]
        return np.unique(wanted, axis=0).astype(np.int32).reshape(-1, 3)

    def _read(self) -> tuple["wp.array", "wp.array"]:
        from geokit.volume.level_set.leaf_neighbors_kernels import read_rows_kernel

        count = len(self.tiles)
        values = wp.empty(512 * count, dtype=wp.float64, device=self.device)
        inside = wp.empty(8 * count, dtype=wp.uint64, device=self.device)
        inputs = [self.handle, self.on_device, self._isovalue]
        launcher.launch(read_rows_kernel, 8 * count, inputs, [values, inside], self.device, grain=64)
        return values, inside

    def _link(self) -> None:
        from geokit.volume.level_set.leaf_neighbors_kernels import link_kernel

        count, device = len(self.tiles), self.device
        self.require_memory(count)
        require_places(self.tiles, self.volume.info.name)
        self.on_device = wp.array(self.tiles, dtype=wp.vec3i, device=device)
        self.beside = wp.empty((count, 27), dtype=wp.int32, device=device)
        if not count:
            return
        corner = self.tiles.min(axis=0).astype(np.int64) - 1
        place = self.tiles.astype(np.int64) - corner
        if place.max() >= (1 << KEY_BITS) - 1:
            raise InputError(
                f"volume: its leaves span {8 * int(place.max()):,} voxels, more than {8 << KEY_BITS:,}; clip it, or "
                "use a volume per object"
            )
        keys = keys_of(place)
        rows = np.argsort(keys, kind="stable")
        table = [wp.array(keys[rows], dtype=wp.int64, device=device)]
        table.append(wp.array(rows.astype(np.int32), dtype=wp.int32, device=device))
        inputs: list[Any] = [self.on_device, *table, wp.vec3i(*corner.tolist()), self.handle, self._isovalue]
        launcher.launch(link_kernel, 27 * count, inputs, [self.beside], device)

    def require_memory(self, count: float) -> None:
        """Raise DeviceMemoryError if ``count`` rows do not fit into the device's memory."""
        need, have = count * BYTES_PER_ROW, available_memory.available(self.device)
        if need > have or count > MOST_LEAVES:
            raise DeviceMemoryError(
                f"volume: a band of {count:.6g} leaves needs {need / (1 << 20):.6g} MiB of the {have >> 20} MiB free "
                f"on {self.device.alias}, and at most {MOST_LEAVES:,} leaves can be counted; use a narrower band, or "
                "resample the volume at a larger voxel_size",
                need=need,
            )
