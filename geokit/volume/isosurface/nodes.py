"""Lists the lower nodes, leaves and active tiles of a NanoVDB buffer, with their offsets and origins.

A surface can cross an active tile of 128^3 or 4096^3 voxels only where that touches nodes or other values. Faces of a
surface belong to crossings between two voxels beside each other of which one is active, so what touches a tile at an
edge or a corner alone does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.late_warp import wp
from geokit.errors import DeviceMemoryError
from geokit.volume.isosurface.launch import LARGEST
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.layout import GridLayout
from geokit.volume.nanovdb.nodes import GridNodes, NodePlaces, grid_nodes, root_origins, set_bits, slot_of, slot_places
from geokit.volume.nanovdb.upload import above_leaves
from geokit.volume.tree.estimates import require_host_room
from geokit.volume.tree.grid_head import root_keys_of

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


@dataclass(eq=False)
class Topology:
    """Nodes of a grid, independent of the isovalue; cached per volume, because they take as long as finding the cells.

    Attributes:
        layout: Layout of nodes of the grid's type.
        begins: Byte offsets of leaves and lower nodes from the grid's start.
        lower: Lower nodes in the order of their addresses.
        leaves: Leaves in the order of their addresses.
        active_node: Lower nodes of the active tiles of 8^3 voxels, shape (A,) int32.
        active_slot: Slots of these tiles in them, shape (A,) int32.
        large: Borders of larger active tiles.
        arrays: By device: offsets and origins of the leaves, their lower nodes and slots, origins of the lower nodes.
    """

    layout: GridLayout
    begins: tuple[int, int]
    lower: NodePlaces
    leaves: NodePlaces
    active_node: NDArray[np.int32]
    active_slot: NDArray[np.int32]
    large: LargeTileBorders
    arrays: dict[str, tuple["wp.array", ...]] = field(default_factory=dict)

    @property
    def is_float(self) -> bool:
        """Whether the grid's values are float32, unencoded."""
        return self.layout.name == "float"

    @property
    def has_tiles(self) -> bool:
        """Whether the surface may run through active tiles."""
        return bool(len(self.active_node) or len(self.large.corners))

    def on(self, device: "wp.Device") -> tuple["wp.array", ...]:
        """The arrays on a device."""
        if device.alias not in self.arrays:
            leaves = self.leaves
            self.arrays[device.alias] = (
                wp.array(leaves.starts.astype(np.uint64), dtype=wp.uint64, device=device),
                wp.array(leaves.origins, dtype=wp.vec3i, device=device),
                wp.array(leaves.parents.astype(np.int32), dtype=wp.int32, device=device),
                wp.array(leaves.slots.astype(np.int32), dtype=wp.int32, device=device),
                wp.array(self.lower.origins, dtype=wp.vec3i, device=device),
            )
        return self.arrays[device.alias]


def topology_of(volume: SparseVolume) -> Topology:
    """The nodes of a volume's tree, cached per volume."""
    return volume._cache.find("topology", lambda: _find_topology(above_leaves(volume)))


def _find_topology(buffer: NDArray[np.uint8]) -> Topology:
    grid = grid_nodes(buffer)
    upper = grid.upper_places()
    lower = grid.upper.children(upper.origins)
    leaves = grid.lower.children(lower.origins)
    node, slot = (part.astype(np.int32) for part in set_bits(grid.lower.tile_mask))
    begins = grid.leaf.begin, grid.lower.begin
    return Topology(grid.leaf.layout, begins, lower, leaves, node, slot, large_tile_borders(grid, upper))


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
