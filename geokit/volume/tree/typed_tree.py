"""The tree of a grid of any value type as arrays: its leaves, and the tiles in regions without leaves.

Only what differs from the background is stored: a node whose slots are all leaves or inactive background is not,
because its position follows from those of its leaves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.header import grid_header
from geokit.volume.nanovdb.layout import LAYOUTS, LEAF_VOXELS, LOWER_SLOTS, UPPER_SLOTS, GridLayout, layout_of
from geokit.volume.nanovdb.nodes import NodeLevel, bits_of, grid_nodes, root_origins, slot_of, slot_places
from geokit.volume.tree.estimates import require_host_room
from geokit.volume.tree.grid_head import root_keys_of

# Types whose leaves store their values unencoded: all but the quantized ones.
VALUE_TYPES = tuple(name for name, layout in LAYOUTS.items() if not layout.leaf_header)


class Nodes(NamedTuple):
    """Nodes of one level above the leaves; or tiles of one size, without the axis of slots.

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

    def corners(self, slots: NDArray[np.bool_], width: int, span: int) -> NDArray[np.int32]:
        """First voxels of the slots in a mask (N, slots), of nodes of ``width``^3 slots of ``span``^3 voxels."""
        node, slot = np.nonzero(slots)
        return self.origins[node] + np.int32(span) * slot_places(slot, width)

    @staticmethod
    def none(layout: GridLayout, *slots: int) -> Nodes:
        """No nodes."""
        values = np.empty((0, *slots, *layout.background.shape), layout.background.base)
        return Nodes(np.empty((0, 3), np.int32), values, np.empty((0, *slots), np.bool_))

    @staticmethod
    def of_tiles(
        origins: NDArray[np.int32], values: Any, active: bool, background: NDArray[Any], width: int, span: int
    ) -> Nodes:
        """The nodes of ``width``^3 slots that hold tiles of ``span``^3 voxels, with background elsewhere."""
        own, node = np.unique(origins & ~np.int32(width * span - 1), axis=0, return_inverse=True)
        place = node.reshape(-1), slot_of(origins, width, span)
        table = np.empty((len(own), width**3, *background.shape), background.dtype)
        table[:] = background
        states = np.zeros(table.shape[:2], np.bool_)
        table[place], states[place] = values, active
        return Nodes(own, table, states)

    @staticmethod
    def joined(parts: list[Nodes]) -> Nodes:
        """The nodes of all parts."""
        return Nodes(*map(np.concatenate, zip(*parts, strict=True)))


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
        root: Tiles of the root, of 4096^3 voxels.
    """

    layout: GridLayout
    background: NDArray[Any]
    origins: NDArray[np.int32]
    masks: NDArray[np.uint8]
    values: NDArray[Any]
    lower: Nodes
    upper: Nodes
    root: Nodes

    def tiles_at(
        self, origins: NDArray[np.int32], *, below_root: bool = True
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Tiles at positions (N, 3) without a leaf: values (N,) or (N, C), and whether they are active (N,).

        If ``below_root`` is false, only the root's tiles are read.
        """
        values = np.empty((len(origins), *self.layout.background.shape), self.layout.background.base)
        values[:] = self.background
        active = np.zeros(len(origins), np.bool_)
        row = RowTable(self.root.origins).find(origins & ~np.int32(4095))
        values[row >= 0], active[row >= 0] = self.root.values[row[row >= 0]], self.root.active[row[row >= 0]]
        # A lower node's tile is written last, since it is the more specific one.
        for nodes, width, span in ((self.upper, 32, 128), (self.lower, 16, 8)) if below_root else ():
            row = RowTable(nodes.origins).find(origins & ~np.int32(span * width - 1))
            inside = row >= 0
            slot = slot_of(origins[inside], width, span)
            values[inside], active[inside] = nodes.values[row[inside], slot], nodes.active[row[inside], slot]
        return values, active


def differs(values: NDArray[Any], background: NDArray[Any]) -> NDArray[np.bool_]:
    """Mask of the values (..., C) that differ from the background, bit by bit."""
    base = values.dtype
    raw = np.dtype(f"u{base.itemsize}")
    unlike = values.view(raw) != np.asarray(background, base).view(raw)
    return unlike.any(axis=-1) if np.ndim(background) else unlike


def tree_of(volume: SparseVolume) -> TypedTree:
    """Read the tree of a grid of one of VALUE_TYPES.

    Raises:
        FileFormatError: The buffer is not a valid grid.
        UnsupportedGridError: The grid does not store its values unencoded.
        DeviceMemoryError: A copy of the grid does not fit into memory.
    """
    buffer = volume.nanovdb
    where = f"volume {volume.info.name!r}"
    check_volume(volume)
    # The arrays, and the grid that an operation makes of them.
    require_host_room(2 * len(buffer), f"{where}: copies of its nodes")
    layout = layout_of(int(grid_header(buffer)["grid_type"]), where)
    grid = grid_nodes(buffer, layout)
    background, table = grid.background.copy(), grid.table
    is_tile = table["child"] == 0
    root = Nodes(root_origins(table["key"][is_tile]), table["value"][is_tile], table["state"][is_tile] != 0)
    upper = grid.upper_places().origins
    lower = grid.upper.children(upper).origins
    leaf = grid.lower.children(lower).origins
    nodes = _tiles_of(grid.lower, lower, background), _tiles_of(grid.upper, upper, background)
    return TypedTree(layout, background, leaf, *_leaf_contents(grid.leaf), *nodes, root)


def tree_of_leaves(
    layout: GridLayout,
    background: NDArray[Any],
    origins: NDArray[np.int32],
    masks: NDArray[np.uint8],
    values: NDArray[Any],
) -> TypedTree:
    """Build a tree that has leaves only."""
    nodes = (Nodes.none(layout, *slots) for slots in ((LOWER_SLOTS,), (UPPER_SLOTS,), ()))
    return TypedTree(layout, background, origins, masks, values, *nodes)


def voxelized_tree(tree: TypedTree, name: str) -> TypedTree:
    """Convert the active tiles of a tree to leaves, which follow the existing ones.

    Raises:
        DeviceMemoryError: The tiles of the grid ``name`` hold more voxels than fit into memory.
    """
    if not (tree.root.active.any() or tree.upper.active.any() or tree.lower.active.any()):
        return tree
    sources = (
        (tree.root.origins[tree.root.active], tree.root.values[tree.root.active], 512),
        (tree.upper.corners(tree.upper.active, 32, 128), tree.upper.values[tree.upper.active], 16),
        (tree.lower.corners(tree.lower.active, 16, 8), tree.lower.values[tree.lower.active], 1),
    )
    count = sum(len(origins) * width**3 for origins, _, width in sources)
    # The leaves in the tree, in the new grid, and in one copy during the conversion.
    need = count * 3 * (LEAF_VOXELS * max(1, tree.layout.background.itemsize) + 100)
    require_host_room(need, f"volume: as voxels, the active tiles of grid {name!r}")
    origins, values = [tree.origins], [tree.values]
    for corners, tiles, width in sources:
        if not len(tiles):
            continue
        steps = slot_places(np.arange(width**3), width) * np.int32(8)
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


def _tiles_of(level: NodeLevel, origins: NDArray[np.int32], background: NDArray[Any]) -> Nodes:
    """The nodes of a level with the given origins that hold a tile other than inactive background."""
    kept = [Nodes.none(level.layout, level.slots)]
    for first, part in level.parts():
        child, active, tiles = bits_of(part.child_mask), bits_of(part.tile_mask), part.values
        some = np.flatnonzero((active | (differs(tiles, background) & ~child)).any(axis=1))
        if len(some):
            values = tiles[some]
            values[child[some]] = background
            kept.append(Nodes(origins[first + some], values, active[some]))
    return Nodes.joined(kept)


def _leaf_contents(leaf: NodeLevel) -> tuple[NDArray[np.uint8], NDArray[Any]]:
    masks = np.ascontiguousarray(leaf.value_mask)
    if leaf.layout.name == "mask":
        return masks, bits_of(masks)
    if leaf.layout.name == "bool":
        return masks, bits_of(leaf.bits)
    return masks, leaf.values


class RowTable:
    """Finds rows by their first voxels (R, 3), multiples of 8."""

    def __init__(self, origins: NDArray[np.int32]) -> None:
        self._roots = np.unique(root_keys_of(origins))
        keys = self._keys(origins)
        self._order = np.argsort(keys)
        self._keys_in_order = keys[self._order]

    def find(self, origins: NDArray[Any]) -> NDArray[np.int64]:
        """Row of each place (N, 3), -1 without one."""
        if not len(self._order):
            return np.full(len(origins), -1)
        keys = self._keys(origins)
        at = np.minimum(np.searchsorted(self._keys_in_order, keys), len(self._order) - 1)
        limits = np.iinfo(np.int32)
        known = (self._keys_in_order[at] == keys) & ((origins >= limits.min) & (origins <= limits.max)).all(axis=1)
        return np.where(known, self._order[at], -1)

    def _keys(self, origins: NDArray[Any]) -> NDArray[np.int64]:
        """Rank of the root entry, then the place in it in units of leaves; -1 without a root entry."""
        roots = root_keys_of(origins)
        rank = np.minimum(np.searchsorted(self._roots, roots), len(self._roots) - 1)
        return np.where(self._roots[rank] == roots, rank << 27 | slot_of(origins, 512, 8), -1)


def _without_active(nodes: Nodes, background: NDArray[Any]) -> Nodes:
    """Replace active tiles by inactive background, and drop nodes that then hold nothing else."""
    inactive = differs(nodes.values, background) & ~nodes.active
    kept = np.flatnonzero(inactive.any(axis=1))
    values = nodes.values[kept]
    values[nodes.active[kept]] = background
    return Nodes(nodes.origins[kept], values, np.zeros_like(nodes.active[kept]))
