"""Where active tiles of 128^3 and 4096^3 voxels touch nodes or other values: only there can a surface cross them.

Faces of a surface belong to crossings between two voxels beside each other of which one is active, so what touches a
tile at an edge or a corner alone does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import DeviceMemoryError
from geokit.volume.isosurface.launch import LARGEST
from geokit.volume.nanovdb.nodes import GridNodes, NodePlaces, root_origins, set_bits, slot_of, slot_places
from geokit.volume.tree.estimates import require_host_room
from geokit.volume.tree.root_table import root_keys_of

__all__ = ["LargeTileBorders", "large_tile_borders"]

# Steps to the neighbors of a tile across its faces.
AROUND = np.concatenate([np.eye(3, dtype=np.int32), -np.eye(3, dtype=np.int32)])
# Bytes of a block at a border: its place here, sorted and on the device.
BLOCK_BYTES = 64
# Bytes of a triangle and of half a vertex.
FACE_BYTES = 24


@dataclass(frozen=True)
class LargeTileBorders:
    """Pairs of a large active tile and what touches it, if that is a node or a tile of another value.

    Attributes:
        corners: First voxel of the tile, (K, 3).
        sizes: Its length [blocks of 8^3 voxels], (K,).
        steps: Row of AROUND that leads to the other side, (K,).
        values: The tile's value and that of the tile or background beside it, (K, 2).
        is_node: Whether there is a node beside it, (K,).
    """

    corners: NDArray[np.int32]
    sizes: NDArray[np.int64]
    steps: NDArray[np.int64]
    values: NDArray[np.float64]
    is_node: NDArray[np.bool_]

    def blocks(self, isovalue: float) -> NDArray[np.int32]:
        """First voxels of the blocks in large tiles that an isosurface may cross, shape (N, 3); some twice.

        Raises:
            DeviceMemoryError: The blocks do not fit into memory.
        """
        rows = np.flatnonzero(self.is_node | self._crossed(isovalue))
        require_host_room(int((self.sizes[rows] ** 2).sum()) * BLOCK_BYTES, "volume: the borders of its active tiles")
        found = [np.empty((0, 3), np.int32)]
        for step, way in enumerate(AROUND):
            for size in (16, 512):
                corners = self.corners[rows[(self.steps[rows] == step) & (self.sizes[rows] == size)]]
                found.append((corners[:, None] + 8 * _face(size, way)).reshape(-1, 3))
        return np.concatenate(found)

    def require_countable(self, isovalue: float) -> None:
        """Check that the surface between large tiles alone can be counted and fits into memory.

        Raises:
            DeviceMemoryError: It has more faces than can be counted, or they do not fit.
        """
        # Two active tiles name a cell twice, and the surface has two faces in it.
        fewest = int(((8 * self.sizes[self._crossed(isovalue)]) ** 2).sum())
        if fewest > LARGEST:
            raise DeviceMemoryError(
                f"volume: its surface has more than {LARGEST} vertices or faces, {fewest:,} of them between tiles; "
                "resample it to larger voxels"
            )
        require_host_room(fewest * FACE_BYTES, "volume: the faces of the surface of its active tiles")

    def _crossed(self, isovalue: float) -> NDArray[np.bool_]:
        return ~self.is_node & ((self.values < isovalue).sum(axis=1) == 1)


def large_tile_borders(grid: GridNodes, upper: NodePlaces) -> LargeTileBorders:
    """Find the borders of a grid's large active tiles.

    Args:
        grid: The nodes of a scalar grid.
        upper: Where its upper nodes are.
    """
    node, slot = set_bits(grid.upper.tile_mask)
    table = grid.table
    tiles = table[(table["state"] != 0) & (table["child"] == 0)]
    parts = [(np.empty((0, 3), np.int32), np.empty((2, 0), np.int64), np.empty((0, 2)), np.empty(0, np.bool_))]
    for corners, values, size in (
        (upper.origins[node] + 128 * slot_places(slot, 32), grid.upper.values[node, slot], 16),
        (root_origins(tiles["key"]), tiles["value"], 512),
    ):
        for number, step in enumerate(AROUND) if len(corners) else ():
            is_node, there = _beside(grid, upper, corners + np.int32(8 * size) * step, size == 16)
            # Not a number differs from itself.
            rows = np.flatnonzero(is_node | (there != values))
            pairs = np.stack([values[rows], there[rows]], axis=1).astype(np.float64)
            parts.append((corners[rows], np.full((2, len(rows)), [[size], [number]]), pairs, is_node[rows]))
    found = [np.concatenate(part, axis=axis) for part, axis in zip(zip(*parts, strict=True), (0, 1, 0, 0), strict=True)]
    return LargeTileBorders(found[0], *found[1], *found[2:])


def _beside(
    grid: GridNodes, upper: NodePlaces, voxels: NDArray[np.int32], within: bool
) -> tuple[NDArray[np.bool_], NDArray[Any]]:
    """Whether there is a node at each voxel (N, 3), and the value of the tile or background there if not.

    If ``within`` is false, upper nodes count as nodes; else the tiles in them are looked at.
    """
    table = grid.table
    order, keys = np.argsort(table["key"]), root_keys_of(voxels)
    entry = order[np.minimum(np.searchsorted(table["key"], keys, sorter=order), len(order) - 1)]
    known = table["key"][entry] == keys
    there = np.where(known, table["value"][entry], grid.background)
    is_node = known & (table["child"][entry] != 0)
    if within:
        row = np.full(len(table), -1)
        row[upper.slots] = np.arange(len(upper.slots))
        some = np.flatnonzero(is_node)
        node, slot = row[entry[some]], slot_of(voxels[some], 32, 128)
        is_node[some] = grid.upper.child_mask[node, slot >> 3] >> (slot & 7).astype(np.uint8) & 1
        there[some] = grid.upper.values[node, slot]
    return is_node, there


def _face(size: int, step: NDArray[np.int32]) -> NDArray[np.int32]:
    """Places (N, 3) of the blocks at one face of a cube with ``size`` blocks along each edge."""
    ends = {-1: np.zeros(1, np.int32), 0: np.arange(size, dtype=np.int32), 1: np.full(1, size - 1, np.int32)}
    return np.stack(np.meshgrid(*(ends[int(d)] for d in step), indexing="ij"), axis=-1).reshape(-1, 3)
