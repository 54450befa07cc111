"""The tree of a grid of any value type as arrays: its leaves, and the tiles in regions without leaves.

Only what differs from the background is stored: a node whose slots are all leaves or inactive background is not,
because its position follows from those of its leaves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import available_memory
from geokit.errors import DeviceMemoryError
from geokit.volume._model import SparseVolume
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.header import TREE_OFFSET, grid_header, tree_header
from geokit.volume.nanovdb.layout import LAYOUTS, LEAF_VOXELS, LOWER_SLOTS, UPPER_SLOTS, GridLayout, layout_of
from geokit.volume.tree.root_table import root_origins, root_tile_type

__all__ = [
    "VALUE_TYPES",
    "Nodes",
    "RootTiles",
    "TypedTree",
    "bits_of",
    "differs",
    "leaf_values_begin",
    "rows_in",
    "slot_of",
    "tree_of",
    "tree_of_leaves",
    "voxelized_tree",
]

# Types whose leaves store their values unencoded: all but the quantized ones.
VALUE_TYPES = tuple(name for name, layout in LAYOUTS.items() if not layout.leaf_header)
# Nodes processed together: the slots of 64 upper nodes are 16 MiB.
NODES_AT_A_TIME = 64


class Nodes(NamedTuple):
    """Nodes of one level above the leaves.

    Attributes:
        origins: First voxel of each, (N, 3) int32.
        values: Values of their tiles, (N, slots) or (N, slots, C); the background if a slot has a child.
        active: Mask of the slots that are active tiles, (N, slots) bool.
    """

    origins: NDArray[np.int32]
    values: NDArray[Any]
    active: NDArray[np.bool_]

    def rows(self, kept: Any) -> Nodes:
        """Select nodes by a mask or by indices."""
        return Nodes(self.origins[kept], self.values[kept], self.active[kept])


class RootTiles(NamedTuple):
    """Tiles of 4096^3 voxels: origins (R, 3) int32, values (R,) or (R, C), active (R,) bool."""

    origins: NDArray[np.int32]
    values: NDArray[Any]
    active: NDArray[np.bool_]

    def rows(self, kept: Any) -> RootTiles:
        """Select tiles by a mask or by indices."""
        return RootTiles(self.origins[kept], self.values[kept], self.active[kept])


@dataclass(frozen=True)
class TypedTree:
    """A grid's tree as arrays.

    Attributes:
        layout: Layout of the grid's type.
        background: Value outside all nodes, () or (C,).
        origins: First voxel of each leaf, (L, 3) int32.
        masks: Active voxels of each leaf, (L, 64) uint8.
        values: Values of each leaf, (L, 512) or (L, 512, C), z fastest; for a mask, its states. May share a grid's
            memory.
        lower: Nodes of 16^3 leaves that hold a tile other than inactive background.
        upper: Nodes of 32^3 lower nodes that hold such a tile.
        root: Tiles of the root.
    """

    layout: GridLayout
    background: NDArray[Any]
    origins: NDArray[np.int32]
    masks: NDArray[np.uint8]
    values: NDArray[Any]
    lower: Nodes
    upper: Nodes
    root: RootTiles

    def tiles_at(
        self, origins: NDArray[np.int32], *, below_root: bool = True
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Tiles at positions (N, 3) without a leaf: values (N,) or (N, C), and whether they are active (N,).

        If ``below_root`` is false, only the root's tiles are read.
        """
        values = np.empty((len(origins), *self.layout.background.shape), self.layout.background.base)
        values[:] = self.background
        active = np.zeros(len(origins), np.bool_)
        row = rows_in(self.root.origins, origins & ~np.int32(4095))
        values[row >= 0], active[row >= 0] = self.root.values[row[row >= 0]], self.root.active[row[row >= 0]]
        # A lower node's tile is written last, since it is the more specific one.
        for nodes, width, span in ((self.upper, 32, 128), (self.lower, 16, 8)) if below_root else ():
            row = rows_in(nodes.origins, origins & ~np.int32(span * width - 1))
            inside = row >= 0
            slot = slot_of(origins[inside], width, span)
            values[inside], active[inside] = nodes.values[row[inside], slot], nodes.active[row[inside], slot]
        return values, active


def slot_of(origins: NDArray[np.int32], width: int, span: int) -> NDArray[np.int64]:
    """Slot index of voxels in nodes of ``width``^3 slots of ``span`` voxels each."""
    at = (origins.astype(np.int64) // span) & (width - 1)
    return (at[:, 0] * width + at[:, 1]) * width + at[:, 2]


def differs(values: NDArray[Any], background: NDArray[Any]) -> NDArray[np.bool_]:
    """Mask of the values (..., C) that differ from the background, bit by bit."""
    base = values.dtype
    raw = np.dtype(f"u{base.itemsize}")
    unlike = values.view(raw) != np.asarray(background, base).view(raw)
    return unlike.any(axis=-1) if np.ndim(background) else unlike


def bits_of(masks: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Unpack masks (N, B) to bits (N, 8 B)."""
    return np.unpackbits(masks, axis=1, bitorder="little").view(np.bool_)


def leaf_values_begin(layout: GridLayout) -> int:
    """Offset of a leaf's values, which are its last entry and fill a multiple of 32 bytes."""
    # The bits of a bool leaf directly follow its mask.
    return 80 if layout.name == "bool" else layout.leaf_size - LEAF_VOXELS * layout.background.itemsize


def tree_of(volume: SparseVolume) -> TypedTree:
    """Read the tree of a grid of one of VALUE_TYPES.

    Raises:
        FileFormatError: The buffer is not a valid grid.
        UnsupportedGridError: The grid does not store its values unencoded.
    """
    buffer = volume.nanovdb
    where = f"volume {volume.info.name!r}"
    check_volume(volume)
    layout = layout_of(int(grid_header(buffer)["grid_type"]), where)
    tree = tree_header(buffer)
    begins = [TREE_OFFSET + int(offset) for offset in tree["node_offset"]]
    counts = [int(count) for count in tree["node_count"]]
    kind = layout.background
    at = begins[3] + layout.root_background
    background = buffer[at : at + kind.itemsize].copy().view(kind.base).reshape(kind.shape)
    entries = int(buffer[begins[3] + 24 : begins[3] + 28].view("<u4")[0])
    at = begins[3] + layout.root_size
    table = buffer[at : at + entries * layout.root_tile_size].view(root_tile_type(layout))
    origins = root_origins(table["key"])
    is_tile = table["child"] == 0
    root = RootTiles(origins[is_tile], table["value"][is_tile], table["state"][is_tile] != 0)
    first = np.empty((counts[2], 3), np.int32)
    first[(table["child"][~is_tile] + (begins[3] - begins[2])) // layout.upper_size] = origins[~is_tile]
    level = _Level(buffer, layout, begins[2], layout.upper_size, layout.upper_table, 32, 128)
    upper, first = level.read(first, background, begins[1], layout.lower_size, counts[1])
    level = _Level(buffer, layout, begins[1], layout.lower_size, layout.lower_table, 16, 8)
    lower, first = level.read(first, background, begins[0], layout.leaf_size, counts[0])
    masks, values = _leaf_contents(buffer, layout, begins[0], counts[0])
    return TypedTree(layout, background, first, masks, values, lower, upper, root)


def tree_of_leaves(
    layout: GridLayout,
    background: NDArray[Any],
    origins: NDArray[np.int32],
    masks: NDArray[np.uint8],
    values: NDArray[Any],
) -> TypedTree:
    """Build a tree that has leaves only."""
    kind = layout.background

    def none(slots: int) -> Nodes:
        shape = (0, slots, *kind.shape)
        return Nodes(np.empty((0, 3), np.int32), np.empty(shape, kind.base), np.empty((0, slots), np.bool_))

    root = RootTiles(np.empty((0, 3), np.int32), np.empty((0, *kind.shape), kind.base), np.empty(0, np.bool_))
    return TypedTree(layout, background, origins, masks, values, none(LOWER_SLOTS), none(UPPER_SLOTS), root)


def voxelized_tree(tree: TypedTree, name: str) -> TypedTree:
    """Convert the active tiles of a tree to leaves, which follow the existing ones.

    Raises:
        DeviceMemoryError: The tiles of the grid ``name`` hold more voxels than fit into memory.
    """
    if not (tree.root.active.any() or tree.upper.active.any() or tree.lower.active.any()):
        return tree
    sources = (
        (tree.root.origins[tree.root.active], tree.root.values[tree.root.active], 512),
        (*_active_tiles(tree.upper, 32, 128), 16),
        (*_active_tiles(tree.lower, 16, 8), 1),
    )
    count = sum(len(origins) * width**3 for origins, _, width in sources)
    # The leaves in the tree, in the new grid, and in one copy during the conversion.
    need = count * 3 * (LEAF_VOXELS * max(1, tree.layout.background.itemsize) + 100)
    have = available_memory.available_host()
    if need > have:
        raise DeviceMemoryError(
            f"volume: the active tiles of grid {name!r} need about {need >> 20} MiB as voxels, of {have >> 20} MiB "
            "free; clip it, or resample it at a larger voxel_size"
        )
    origins, values = [tree.origins], [tree.values]
    for corners, tiles, width in sources:
        if not len(tiles):
            continue
        steps = np.stack(np.unravel_index(np.arange(width**3), 3 * (width,)), axis=1).astype(np.int32) * 8
        origins.append((corners[:, None] + steps).reshape(-1, 3))
        row = (LEAF_VOXELS, *tree.background.shape)
        values.append(np.broadcast_to(tiles[:, None, None], (len(tiles), width**3, *row)).reshape(-1, *row))
    added = sum(map(len, origins[1:]))
    return replace(
        tree,
        origins=np.concatenate(origins),
        masks=np.concatenate([tree.masks, np.full((added, LEAF_VOXELS // 8), 255, np.uint8)]),
        values=np.concatenate(values),
        root=tree.root.rows(~tree.root.active),
        upper=_without_active(tree.upper, tree.background),
        lower=_without_active(tree.lower, tree.background),
    )


@dataclass(frozen=True)
class _Level:
    """Location of the nodes of one level: ``width``^3 slots of ``span`` voxels."""

    buffer: NDArray[np.uint8]
    layout: GridLayout
    begin: int
    size: int
    table: int
    width: int
    span: int

    def read(
        self, origins: NDArray[np.int32], background: NDArray[Any], child_begin: int, child_size: int, child_count: int
    ) -> tuple[Nodes, NDArray[np.int32]]:
        """Contents of the nodes with the given origins, and the origins of their children."""
        slots = UPPER_SLOTS if self.width == 32 else LOWER_SLOTS
        kind = self.layout.background
        child_origins = np.empty((child_count, 3), np.int32)
        kept: list[Nodes] = [
            Nodes(
                np.empty((0, 3), np.int32), np.empty((0, slots, *kind.shape), kind.base), np.empty((0, slots), np.bool_)
            )
        ]
        element = kind.base.itemsize
        for first in range(0, len(origins), NODES_AT_A_TIME):
            count = min(NODES_AT_A_TIME, len(origins) - first)
            at = self.begin + first * self.size
            masks = np.ndarray((count, 2, slots // 8), np.uint8, self.buffer, at + 32, (self.size, slots // 8, 1))
            child = bits_of(masks[:, 1])
            active = bits_of(masks[:, 0] & ~masks[:, 1])
            strides = (self.size, self.layout.table_stride)
            shape = (count, slots, *kind.shape)
            tiles = np.ndarray(shape, kind.base, self.buffer, at + self.table, strides + (element,) * (len(shape) - 2))
            offsets = np.ndarray((count, slots), "<i8", self.buffer, at + self.table, strides)
            node, slot = np.nonzero(child)
            row = (at + node * self.size + offsets[node, slot] - child_begin) // child_size
            steps = np.stack(np.unravel_index(slot, 3 * (self.width,)), axis=1).astype(np.int32) * self.span
            child_origins[row] = origins[first + node] + steps
            some = np.flatnonzero((active | (differs(tiles, background) & ~child)).any(axis=1))
            if len(some):
                values = tiles[some]
                values[child[some]] = background
                kept.append(Nodes(origins[first + some], values, active[some]))
        return Nodes(*map(np.concatenate, zip(*kept, strict=True))), child_origins


def _leaf_contents(
    buffer: NDArray[np.uint8], layout: GridLayout, begin: int, count: int
) -> tuple[NDArray[np.uint8], NDArray[Any]]:
    kind, size = layout.background, layout.leaf_size
    if not count:
        return np.empty((0, LEAF_VOXELS // 8), np.uint8), np.empty((0, LEAF_VOXELS, *kind.shape), kind.base)
    masks = np.ascontiguousarray(np.ndarray((count, LEAF_VOXELS // 8), np.uint8, buffer, begin + 16, (size, 1)))
    if layout.name == "mask":
        return masks, bits_of(masks)
    at = begin + leaf_values_begin(layout)
    if layout.name == "bool":
        return masks, bits_of(np.ndarray((count, LEAF_VOXELS // 8), np.uint8, buffer, at, (size, 1)))
    element = kind.base.itemsize
    shape = (count, LEAF_VOXELS, *kind.shape)
    return masks, np.ndarray(shape, kind.base, buffer, at, (size, kind.itemsize, element)[: len(shape)])


def rows_in(table: NDArray[np.int32], wanted: NDArray[np.int32]) -> NDArray[np.int64]:
    """Row of each wanted corner (N, 3) in a table of corners, -1 if it is missing."""
    if not len(table):
        return np.full(len(wanted), -1)
    both, number = np.unique(np.concatenate([table, wanted]), axis=0, return_inverse=True)
    row = np.full(len(both), -1)
    row[number.reshape(-1)[: len(table)]] = np.arange(len(table))
    return row[number.reshape(-1)[len(table) :]]


def _active_tiles(nodes: Nodes, width: int, span: int) -> tuple[NDArray[np.int32], NDArray[Any]]:
    """Corners and values of the active tiles of nodes."""
    node, slot = np.nonzero(nodes.active)
    steps = np.stack(np.unravel_index(slot, 3 * (width,)), axis=1).astype(np.int32) * span
    return nodes.origins[node] + steps, nodes.values[node, slot]


def _without_active(nodes: Nodes, background: NDArray[Any]) -> Nodes:
    """Replace active tiles by inactive background, and drop nodes that then hold nothing else."""
    inactive = differs(nodes.values, background) & ~nodes.active
    kept = np.flatnonzero(inactive.any(axis=1))
    values = nodes.values[kept]
    values[nodes.active[kept]] = background
    return Nodes(nodes.origins[kept], values, np.zeros_like(nodes.active[kept]))
