"""Classification of the tiles of a dense array: leaves, inner tiles, and the contents of the leaves."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.errors import InputError
from geokit.volume.nanovdb.layout import LEAF_VOXELS
from geokit.volume.nanovdb.nodes import grid_nodes, slot_of

# A float leaf; its values and mask before it is written; its origin and place. Some are filled where they will stay.
BYTES_PER_LEAF = 2144 + 2112 + 96
BYTES_PER_FILLED_LEAF = 2144 + 96
# Voxels processed together, so that memory does not grow with the array.
VOXELS_AT_A_TIME = 1 << 22
# Fewest tiles that are worth a slice of a launch: each takes a microsecond.
TILE_GRAIN = 256


class DenseTiles:
    """The tiles of 8^3 voxels that a dense array touches, read a few slabs of eight voxels along x at a time.

    Args:
        dense: Shape (X, Y, Z), real numbers.
        start: Index of its first voxel, shape (3,).
        background: A float32 number.
        tolerance: Largest difference from the background that still counts as background.
        level_set: Whether minus the background counts as background too.
    """

    def __init__(
        self, dense: NDArray[Any], start: NDArray[np.int64], background: float, tolerance: float, level_set: bool
    ) -> None:
        self.dense = dense
        self.background = background
        # Position of the array in its first tile, and the number of tiles.
        self.shift = start & 7
        self.first = start - self.shift
        self.count = [int(n) for n in -(-(self.shift + dense.shape) // 8)] if dense.size else [0, 0, 0]
        self.rule = [wp.float32(background), wp.float64(tolerance), int(level_set)]

    def sort_out(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Origins of the tiles that become leaves, and of those that lie inside the level set.

        Raises:
            InputError: float32 cannot hold a value.
        """
        from geokit.volume.tree.dense_tiles_kernels import BAD, INSIDE, LEAF, tile_state_kernel

        found: dict[int, list[NDArray[np.int64]]] = {LEAF: [np.empty((0, 3), np.int64)]}
        found[INSIDE] = list(found[LEAF])
        for x, slab, shift in self._slabs():
            state = np.empty((-(-(shift[0] + slab.shape[0]) // 8), *self.count[1:]), np.uint8)
            inputs = [slab, shift, *self.count[1:], *self.rule]
            _launch_on_host(tile_state_kernel, state.size, inputs, [state])
            if (state == BAD).any():
                raise self._not_float32(8 * x - int(self.shift[0]))
            for kind, origins in found.items():
                origins.append(self.first + 8 * (np.argwhere(state == kind) + np.array([x, 0, 0])))
        return self._with_hooks(np.concatenate(found[LEAF]), np.concatenate(found[INSIDE]))

    def contents(self, leaves: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Values (L, 512) and packed masks (L, 64) of the tiles with the given origins."""
        values = np.empty((len(leaves), LEAF_VOXELS), np.float32)
        masks = np.empty((len(leaves), LEAF_VOXELS // 8), np.uint8)
        self.fill(leaves, np.arange(len(leaves)), values, masks)
        return values, masks

    def fill(
        self, leaves: NDArray[np.int64], rows: NDArray[np.int64], values: NDArray[np.float32], masks: NDArray[np.uint8]
    ) -> None:
        """Write values and masks of the tiles with the given origins to rows of arrays like those of :meth:`contents`,
        whose rows may lie apart."""
        from geokit.volume.tree.dense_tiles_kernels import fill_tiles_kernel

        tile = (leaves - self.first) >> 3
        order = np.argsort(tile[:, 0], kind="stable")
        for x, slab, shift in self._slabs():
            ends = np.searchsorted(tile[order, 0], [x, x + -(-(shift[0] + slab.shape[0]) // 8)])
            part = order[ends[0] : ends[1]]
            tiles = (tile[part] - np.array([x, 0, 0])).astype(np.int32)
            inputs = [slab, shift, tiles, rows[part].astype(np.int32), *self.rule]
            _launch_on_host(fill_tiles_kernel, len(part), inputs, [values, masks])

    def _slabs(self) -> Iterator[tuple[int, NDArray[Any], tuple[int, int, int]]]:
        """First tile along x, part of the array as float32 or float64, and its offset in that tile."""
        plane = max(1, self.dense.size // max(1, len(self.dense)))
        step = max(1, VOXELS_AT_A_TIME // (8 * plane))
        for x in range(0, self.count[0], step):
            low = max(0, 8 * x - int(self.shift[0]))
            part = self.dense[low : 8 * (x + step) - int(self.shift[0])]
            kept = part.dtype in (np.float32, np.float64) and part.dtype.isnative and part.strides[2] == part.itemsize
            slab = part if kept and min(part.strides) > 0 else np.ascontiguousarray(part, np.float64)
            yield x, slab, (low + int(self.shift[0]) - 8 * x, int(self.shift[1]), int(self.shift[2]))

    def _not_float32(self, x: int) -> InputError:
        for i in range(max(0, x), len(self.dense)):
            with np.errstate(over="ignore"):
                bad = np.argwhere(~np.isfinite(self.dense[i].astype(np.float32)))
            if len(bad):
                y, z = bad[0]
                break
        return InputError(
            f"values: voxel [{i}, {y}, {z}] is {self.dense[i, y, z]}, which float32 cannot hold; replace such voxels"
        )

    @staticmethod
    def _with_hooks(
        leaves: NDArray[np.int64], inside: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        # A tile needs a lower node (128^3 voxels) to be stored in: if no leaf creates one, a tile becomes a leaf.
        have = np.unique(_block_keys(leaves))
        keys = _block_keys(inside)
        _, rows = np.unique(keys, return_index=True)
        rows = rows[~np.isin(keys[rows], have)]
        return np.concatenate([leaves, inside[rows]]), np.delete(inside, rows, axis=0)


def _launch_on_host(kernel: Any, count: int, inputs: list[Any], outputs: list[Any]) -> None:
    """Launch on the CPU with NumPy arrays, whose memory the kernel uses directly."""

    def shared(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return wp.array(value, device="cpu", copy=False)
        return wp.vec3i(*value) if isinstance(value, tuple) else value

    device = launcher.resolve_device("cpu")
    launcher.launch(kernel, count, [*map(shared, inputs)], [*map(shared, outputs)], device, grain=TILE_GRAIN)


def _block_keys(origins: NDArray[np.int64]) -> NDArray[np.int64]:
    """One key for each lower node (128^3 voxels) that contains one of the voxels (N, 3) of an array."""
    # int32 indices leave 25 bits of each coordinate of a block, of which 21 distinguish the blocks of an array.
    block = (origins >> 7) & ((1 << 21) - 1)
    return block[:, 0] << 42 | block[:, 1] << 21 | block[:, 2]


def mark_inside(buffer: NDArray[np.uint8], inside: NDArray[np.int64], background: float) -> None:
    """Write the value of the inner tiles into their slots; each has a lower node. The checksum does not cover nodes."""
    if not len(inside):
        return
    lower = grid_nodes(buffer).lower
    node_keys = _block_keys(lower.origins.astype(np.int64))
    order = np.argsort(node_keys, kind="stable")
    node = order[np.searchsorted(node_keys[order], _block_keys(inside))]
    lower.values[node, slot_of(inside, lower.width, lower.span)] = -background
