"""Where the nodes of a grid go: leaves grouped into lower and upper nodes, in breadth-first order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError
from geokit.volume.nanovdb.header import FLAG_HAS_BBOX, HEAD_SIZE, grid_header
from geokit.volume.nanovdb.layout import GridLayout

__all__ = ["LOWER", "UPPER", "Level", "Topology", "link_nodes", "root_keys_of", "root_span", "topology_of", "with_gaps"]

# Tiles between upper nodes are written one by one: this many are 2 MiB and cover 2.7e8 voxels of solid along an axis.
LARGEST_GAP_TILES = 1 << 16
# Of a coordinate in the key of an entry of the root.
ROOT_BITS = 20
ROOT_TILE = np.dtype(
    {
        "names": ["key", "child", "state", "value"],
        "formats": ["<u8", "<i8", "<u4", "<f4"],
        "offsets": [0, 8, 16, 20],
        "itemsize": 32,
    }
)


@dataclass(frozen=True)
class Topology:
    """Order and place of every node of a grid.

    Attributes:
        leaf_origins: First voxel of each leaf, in order, shape (L, 3).
        order: Rows of the given origins, in the grid's order.
        leaf_lower: Lower node of each leaf, ascending.
        leaf_slot: Slot of each leaf in its lower node.
        lower_upper: Upper node of each lower node, ascending.
        lower_slot: Slot of each lower node in its upper node.
        root_keys: Keys of the root's table, ascending.
        root_child: Upper node of each entry, -1 for a tile.
        gaps: Entries between two upper nodes along z, as (row, upper node below, upper node above).
        root_begin: Byte at which the root starts; the other begins likewise.
        size: Bytes of the grid.
        signed_fill: Whether empty regions take the sign of their surroundings.
    """

    leaf_origins: NDArray[np.int32]
    order: NDArray[np.int64]
    leaf_lower: NDArray[np.int64]
    leaf_slot: NDArray[np.int64]
    lower_upper: NDArray[np.int64]
    lower_slot: NDArray[np.int64]
    root_keys: NDArray[np.uint64]
    root_child: NDArray[np.int64]
    gaps: list[tuple[int, int, int]]
    root_begin: int
    upper_begin: int
    lower_begin: int
    leaf_begin: int
    size: int
    signed_fill: bool

    @property
    def leaf_count(self) -> int:
        """Number of leaves."""
        return len(self.leaf_lower)

    @property
    def lower_count(self) -> int:
        """Number of lower nodes."""
        return len(self.lower_upper)

    @property
    def upper_count(self) -> int:
        """Number of upper nodes."""
        return int((self.root_child >= 0).sum())

    def root_tiles(self, buffer: NDArray[np.uint8], layout: GridLayout) -> NDArray[np.void]:
        """The root's table, sharing the buffer's memory."""
        begin = self.root_begin + layout.root_size
        return buffer[begin : begin + len(self.root_keys) * ROOT_TILE.itemsize].view(ROOT_TILE)


@dataclass(frozen=True)
class Level:
    """One of the two kinds of internal nodes: its slots and its voxels along an axis."""

    width: int
    span: int
    upper: bool

    def place(self, topology: Topology, layout: GridLayout) -> tuple[int, int, int, int]:
        """First byte, number, size and offset of the slots of the nodes."""
        if self.upper:
            return topology.upper_begin, topology.upper_count, layout.upper_size, layout.upper_table
        return topology.lower_begin, topology.lower_count, layout.lower_size, layout.lower_table

    def _view(
        self, buffer: NDArray[np.uint8], topology: Topology, layout: GridLayout, dtype: str, offset: int, count: int
    ) -> NDArray[Any]:
        begin, nodes, size, _ = self.place(topology, layout)
        step = np.dtype(dtype).itemsize
        return np.ndarray((nodes, count), dtype, buffer, begin + offset, (size, step))

    def tiles(self, buffer: NDArray[np.uint8], topology: Topology, layout: GridLayout) -> NDArray[np.float32]:
        """Values of the slots, shape (nodes, width^3), valid where there is no child."""
        begin, nodes, size, table = self.place(topology, layout)
        strides = (size, layout.table_stride)
        return np.ndarray((nodes, self.width**3), "<f4", buffer, begin + table, strides)

    def children(self, buffer: NDArray[np.uint8], topology: Topology, layout: GridLayout) -> NDArray[np.int64]:
        """Child offsets of the slots, shape (nodes, width^3), valid where there is a child."""
        begin, nodes, size, table = self.place(topology, layout)
        strides = (size, layout.table_stride)
        return np.ndarray((nodes, self.width**3), "<i8", buffer, begin + table, strides)

    def child_mask(self, buffer: NDArray[np.uint8], topology: Topology, layout: GridLayout) -> NDArray[np.uint8]:
        """Packed child masks, shape (nodes, width^3 / 8)."""
        count = self.width**3 // 8
        return self._view(buffer, topology, layout, "u1", 32 + count, count)

    def write_statistics(
        self,
        buffer: NDArray[np.uint8],
        topology: Topology,
        layout: GridLayout,
        origins: NDArray[np.int32],
        boxes: NDArray[np.int32],
        extrema: NDArray[np.float32],
    ) -> None:
        """Store box, flag, minimum and maximum of the nodes."""
        some = boxes[:, 0, 0] <= boxes[:, 1, 0]
        # Readers take a node's origin from its box: an empty one starts there too, and ends before it.
        empty = np.stack([origins, np.full_like(origins, np.iinfo(np.int32).min)], axis=1)
        kept = np.where(some[:, None, None], boxes, empty)
        self._view(buffer, topology, layout, "<i4", 0, 6)[:] = kept.reshape(-1, 6)
        self._view(buffer, topology, layout, "<u8", 24, 1)[:, 0] = np.where(some, FLAG_HAS_BBOX, 0)
        limits = self._view(buffer, topology, layout, "<f4", 32 + 2 * self.width**3 // 8, 2)
        limits[:] = np.where(some[:, None], extrema, 0.0)


LOWER = Level(16, 128, upper=False)
UPPER = Level(32, 4096, upper=True)


def topology_of(leaf_origins: NDArray[np.int32], layout: GridLayout, *, fill_gaps: bool) -> Topology:
    """Order leaves and their nodes as NanoVDB wants them.

    Args:
        leaf_origins: Multiples of 8, shape (L, 3), each once, any order.
        layout: Of the grid's type.
        fill_gaps: Reserve root tiles between upper nodes along z.

    Raises:
        InputError: Origins of the wrong shape, off the lattice, twice, or too far apart to be filled.
    """
    origins = _checked_origins(leaf_origins)
    x, y, z = (origins[:, axis].astype(np.int64) for axis in range(3))
    lower_slot = ((x >> 7) & 31) << 10 | ((y >> 7) & 31) << 5 | ((z >> 7) & 31)
    leaf_slot = ((x >> 3) & 15) << 8 | ((y >> 3) & 15) << 4 | ((z >> 3) & 15)
    uppers, upper_of_leaf = np.unique(root_keys_of(origins), return_inverse=True)
    place = upper_of_leaf.reshape(-1).astype(np.int64) << 27 | lower_slot << 12 | leaf_slot
    order = np.argsort(place, kind="stable")
    place = place[order]
    twice = np.flatnonzero(place[1:] == place[:-1])
    if len(twice):
        raise InputError(f"leaf_origins: row {order[twice[0] + 1]} repeats row {order[twice[0]]}; give each leaf once")
    lower_place, leaf_lower = np.unique(place >> 12, return_inverse=True)
    keys, child, gaps = with_gaps(uppers, fill_gaps)
    root_begin = HEAD_SIZE
    upper_begin = root_begin + layout.root_size + len(keys) * layout.root_tile_size
    lower_begin = upper_begin + len(uppers) * layout.upper_size
    leaf_begin = lower_begin + len(lower_place) * layout.lower_size
    return Topology(
        leaf_origins=origins[order],
        order=order,
        leaf_lower=leaf_lower.reshape(-1),
        leaf_slot=place & 0xFFF,
        lower_upper=lower_place >> 15,
        lower_slot=lower_place & 0x7FFF,
        root_keys=keys,
        root_child=child,
        gaps=gaps,
        root_begin=root_begin,
        upper_begin=upper_begin,
        lower_begin=lower_begin,
        leaf_begin=leaf_begin,
        size=leaf_begin + len(origins) * layout.leaf_size,
        signed_fill=fill_gaps,
    )


def _checked_origins(leaf_origins: NDArray[np.int32]) -> NDArray[np.int32]:
    origins = np.asarray(leaf_origins)
    if origins.ndim != 2 or origins.shape[1] != 3 or not np.issubdtype(origins.dtype, np.integer):
        raise InputError(
            f"leaf_origins: {origins.dtype} {origins.shape} is not an integer array (L, 3); give voxel indices"
        )
    limits = np.iinfo(np.int32)
    bad = np.flatnonzero(((origins & 7 != 0) | (origins < limits.min) | (origins > limits.max)).any(axis=1))
    if len(bad):
        row = bad[0]
        raise InputError(f"leaf_origins: row {row} is {origins[row].tolist()}; give int32 multiples of 8")
    return np.ascontiguousarray(origins, np.int32)


def root_keys_of(voxels: NDArray[Any]) -> NDArray[np.uint64]:
    """Keys of the root's entries for voxels (N, 3)."""
    # 20 bits of each coordinate, negative ones wrapped as NanoVDB does by shifting unsigned.
    x, y, z = voxels.T.astype(np.int64) >> 12 & ((1 << ROOT_BITS) - 1)
    return np.asarray((x << 42 | y << 21 | z).astype(np.uint64))


def with_gaps(
    uppers: NDArray[np.uint64], fill_gaps: bool
) -> tuple[NDArray[np.uint64], NDArray[np.int64], list[tuple[int, int, int]]]:
    """The root's table, with a tile for every place between two upper nodes on one line along z."""
    numbers = np.arange(len(uppers))
    if not fill_gaps or len(uppers) < 2:
        return uppers, numbers, []
    line = uppers >> np.uint64(21)
    # Signed z decides what lies between: the keys' own order puts negative ones last.
    z = (uppers & np.uint64((1 << 21) - 1)).astype(np.int64)
    z = np.where(z >= 1 << 19, z - (1 << 20), z)
    order = np.lexsort((z, line))
    below, above = order[:-1], order[1:]
    missing = np.where(line[below] == line[above], z[above] - z[below] - 1, 0)
    if missing.sum() > LARGEST_GAP_TILES:
        raise InputError(
            f"leaf_origins: {int(missing.sum())} empty nodes of 4096^3 voxels lie between the leaves, more than "
            f"{LARGEST_GAP_TILES}; use larger voxels or a volume per object"
        )
    pair = np.repeat(np.arange(len(below)), missing)
    step = np.arange(len(pair)) - np.repeat(np.cumsum(missing) - missing, missing)
    tile_z = (z[below][pair] + 1 + step) & ((1 << 20) - 1)
    tiles = line[below][pair] << np.uint64(21) | tile_z.astype(np.uint64)
    keys = np.concatenate([uppers, tiles])
    rank = np.argsort(keys, kind="stable")
    child = np.concatenate([numbers, np.full(len(tiles), -1)])[rank]
    row_of = np.empty(len(keys), np.int64)
    row_of[rank] = np.arange(len(keys))
    rows = row_of[len(uppers) :]
    gaps = list(zip(rows.tolist(), below[pair].tolist(), above[pair].tolist(), strict=True))
    return keys[rank], child, gaps


def link_nodes(buffer: NDArray[np.uint8], topology: Topology, layout: GridLayout, background: float) -> None:
    """Write root table, child masks and offsets; all slots without child become inactive background tiles."""
    root = buffer[topology.root_begin :]
    root[24:28].view("<u4")[0] = len(topology.root_keys)
    table = topology.root_tiles(buffer, layout)
    table["key"] = topology.root_keys
    table["value"] = background
    has_child = topology.root_child >= 0
    to_upper = topology.upper_begin - topology.root_begin + topology.root_child * layout.upper_size
    table["child"] = np.where(has_child, to_upper, 0)
    for level, node, slot, child_begin, child_size, parent_begin, parent_size in (
        (UPPER, topology.lower_upper, topology.lower_slot, topology.lower_begin, layout.lower_size,
         topology.upper_begin, layout.upper_size),
        (LOWER, topology.leaf_lower, topology.leaf_slot, topology.leaf_begin, layout.leaf_size,
         topology.lower_begin, layout.lower_size),
    ):  # fmt: skip
        if not len(node):
            continue
        level.tiles(buffer, topology, layout)[:] = background
        child = child_begin + np.arange(len(node)) * child_size - (parent_begin + node * parent_size)
        level.children(buffer, topology, layout)[node, slot] = child
        mask = level.child_mask(buffer, topology, layout)
        np.bitwise_or.at(mask, (node, slot >> 3), (1 << (slot & 7)).astype(np.uint8))


def root_span(buffer: NDArray[np.uint8], box: NDArray[np.int32] | None) -> None:
    """Store the grid's world box; its upper corner is the far side of the last voxel, as NanoVDB has it."""
    grid = grid_header(buffer)
    if box is None:
        limits = np.finfo(np.float64)
        grid["world_bbox"] = [limits.max] * 3 + [limits.min] * 3
        return
    ends = np.stack([box[0].astype(np.float64), box[1].astype(np.float64) + 1.0])
    corners = np.array(np.meshgrid(*ends.T, indexing="ij")).reshape(3, -1)
    world = grid["matrix"].reshape(3, 3) @ corners + grid["vector"][:, None]
    grid["world_bbox"] = np.concatenate([world.min(axis=1), world.max(axis=1)])
    grid["flags"] |= FLAG_HAS_BBOX
