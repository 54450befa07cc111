"""Writer of NanoVDB grids of any value type, from their leaves and tiles, on the host."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.launcher import pool
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checksum import partial_checksum
from geokit.volume.nanovdb.header import (
    BLIND_CLASS_NAME,
    BLIND_DATA,
    FLAG_BREADTH_FIRST,
    FLAG_HAS_BBOX,
    FLAG_HAS_MIN_MAX,
    FLAG_LONG_NAME,
    HEAD_SIZE,
    TREE_OFFSET,
    aligned_buffer,
    grid_header,
    info_of,
    tree_header,
)
from geokit.volume.nanovdb.header_options import write_header
from geokit.volume.nanovdb.layout import ALIGNMENT, GRID_TYPES, LAYOUTS
from geokit.volume.nanovdb.nodes import GridNodes, NodeLevel, grid_nodes, set_bits, slot_of, slot_places
from geokit.volume.tree.grid_head import GridHead, head_like
from geokit.volume.tree.root_table import root_keys_of, root_span
from geokit.volume.tree.statistics import Items, add_items, items_of_leaves, items_of_tiles, reduced
from geokit.volume.tree.typed_tree import Nodes, TypedTree, differs, tree_of

__all__ = [
    "WIDENED", "build_grid", "name_block", "rebuilt", "widened", "write_heads", "write_leaves", "write_statistics",
]  # fmt: skip

# Types of small integers that OpenVDB lacks.
WIDENED = ("int16", "uint8")

# Leaves that a thread processes at a time: 256 of them are half a megabyte of floats, which stays in the cache.
LEAVES_AT_A_TIME = 256


class _Places(NamedTuple):
    """Nodes of a grid and their relations, in breadth-first order.

    Attributes:
        leaf_order: Row of each leaf in the tree.
        leaf_lower: Lower node of each leaf.
        leaf_slot: Slot of each leaf in its lower node.
        lower_origins: First voxel of each lower node.
        lower_upper: Upper node of each lower node.
        lower_slot: Slot of each lower node in its upper node.
        lower_row: Row of each lower node in the tree, -1 if the tree does not have it.
        upper_origins: First voxel of each upper node.
        upper_row: Row of each upper node in the tree, -1 if the tree does not have it.
    """

    leaf_order: NDArray[np.int64]
    leaf_lower: NDArray[np.int64]
    leaf_slot: NDArray[np.int64]
    lower_origins: NDArray[np.int32]
    lower_upper: NDArray[np.int64]
    lower_slot: NDArray[np.int64]
    lower_row: NDArray[np.int64]
    upper_origins: NDArray[np.int32]
    upper_row: NDArray[np.int64]


def rebuilt(tree: TypedTree, volume: SparseVolume, transform: NDArray[np.float64] | None = None) -> SparseVolume:
    """Build a volume with another tree; name, class, metadata and the default transform are those of ``volume``."""
    buffer = build_grid(tree, head_like(volume, tree.layout, tree.background, transform))
    info = info_of(buffer, name=volume.info.name)
    return SparseVolume(buffer, replace(info, grid_class=volume.info.grid_class, metadata=volume.info.metadata))


def widened(volume: SparseVolume) -> SparseVolume:
    """A grid of small integers as one of int32, which OpenVDB has too.

    Raises:
        FileFormatError: The buffer is not a valid grid.
    """
    layout = LAYOUTS["int32"]
    tree = tree_of(volume)

    def wide(part: Any) -> Any:
        return part._replace(values=part.values.astype(np.int32))

    outside, values = np.asarray(tree.background, np.int32), tree.values.astype(np.int32)
    tree = replace(tree, layout=layout, background=outside, values=values)
    return rebuilt(replace(tree, lower=wide(tree.lower), upper=wide(tree.upper), root=wide(tree.root)), volume)


def build_grid(tree: TypedTree, head: GridHead) -> NDArray[np.uint8]:
    """Build a NanoVDB grid of any value type from its leaves and tiles.

    Nodes that the leaves need and the tree does not have are filled with the tile that they replace, that of the root
    included. Every node gets its box and its extrema (for vectors by length), but no averages.

    Args:
        tree: Tree with the layout and background of ``head``.
        head: Specification of the grid.
    Returns:
        The grid: uint8, 32-byte aligned, read-only.
    """
    layout = tree.layout
    places = _places(tree)
    keys = root_keys_of(places.upper_origins)
    tile_keys = root_keys_of(tree.root.origins)
    kept = np.flatnonzero(~np.isin(tile_keys, keys))
    upper_begin = HEAD_SIZE + layout.root_size + (len(keys) + len(kept)) * layout.root_tile_size
    lower_begin = upper_begin + len(keys) * layout.upper_size
    leaf_begin = lower_begin + len(places.lower_upper) * layout.lower_size
    tree_end = leaf_begin + len(tree.origins) * layout.leaf_size
    name = name_block(head)
    # Pages from calloc are zero until they are written, so padding costs nothing.
    buffer = aligned_buffer(-(-(tree_end + len(name)) // ALIGNMENT) * ALIGNMENT, zeroed=True)
    buffer[tree_end : tree_end + len(name)] = name
    begins = (leaf_begin, lower_begin, upper_begin, HEAD_SIZE)
    counts = (len(tree.origins), len(places.lower_upper), len(keys))
    write_heads(buffer, head, begins, counts, tree_end)

    grid = grid_nodes(buffer, layout)
    upper, lower = grid.upper, grid.lower
    active_upper = _fill(upper, tree, tree.upper, places.upper_row, places.upper_origins)
    active_lower = _fill(lower, tree, tree.lower, places.lower_row, places.lower_origins)
    _link(upper, places.lower_upper, places.lower_slot, lower.starts)
    _link(lower, places.leaf_lower, places.leaf_slot, grid.leaf.starts)

    items, voxels = write_leaves(grid.leaf, tree, places.leaf_order)
    tile_counts = []
    for level, origins, parent, active in (
        (lower, places.lower_origins, places.leaf_lower, active_lower),
        (upper, places.upper_origins, places.lower_upper, active_upper),
    ):
        node, slot, values = _active_tiles(level, active)
        tile_counts.append(len(node))
        voxels += len(node) * level.span**3
        corners = origins[node] + level.span * slot_places(slot, level.width)
        tiles = items_of_tiles(layout, corners, values, level.span)
        items = reduced(*add_items(items, parent, tiles, node), level.count)
        write_statistics(level, origins, items)
    root = tree.root.rows(kept)
    tile_counts.append(int(root.active.sum()))
    voxels += tile_counts[2] * 4096**3
    tiles = items_of_tiles(layout, root.origins[root.active], root.values[root.active], 4096)
    items = reduced(*add_items(items, np.zeros(upper.count, np.int64), tiles, np.zeros(tile_counts[2], np.int64)), 1)
    _write_root(grid, tree, keys, kept, tile_keys, items)
    header = tree_header(buffer)
    header["tile_count"], header["voxel_count"] = tile_counts, voxels
    grid_header(buffer)["checksum"] = partial_checksum(buffer[:HEAD_SIZE], buffer)
    buffer.setflags(write=False)
    return buffer


def _places(tree: TypedTree) -> _Places:
    parts = (tree.origins, tree.lower.origins, tree.upper.origins)
    keys = [root_keys_of(part) for part in parts]
    root, first = np.unique(np.concatenate(keys), return_index=True)
    upper_origins = (np.concatenate(parts)[first] & ~np.int32(4095)).reshape(-1, 3)
    rank = [np.searchsorted(root, key).astype(np.int64) for key in keys]
    # At most 2^36 upper nodes leave 27 bits for the slots in them.
    leaf_place = rank[0] << 27 | slot_of(parts[0], 32, 128) << 12 | slot_of(parts[0], 16, 8)
    order = np.argsort(leaf_place, kind="stable")
    leaf_place = leaf_place[order]
    old_lower = rank[1] << 15 | slot_of(parts[1], 32, 128)
    lower_place, first = np.unique(np.concatenate([leaf_place >> 12, old_lower]), return_index=True)
    lower_origins = (np.concatenate([tree.origins[order], tree.lower.origins])[first] & ~np.int32(127)).reshape(-1, 3)
    lower_row = np.full(len(lower_place), -1)
    lower_row[np.searchsorted(lower_place, old_lower)] = np.arange(len(old_lower))
    upper_row = np.full(len(root), -1)
    upper_row[rank[2]] = np.arange(len(rank[2]))
    return _Places(
        leaf_order=order,
        leaf_lower=np.searchsorted(lower_place, leaf_place >> 12),
        leaf_slot=leaf_place & 0xFFF,
        lower_origins=lower_origins,
        lower_upper=lower_place >> 15,
        lower_slot=lower_place & 0x7FFF,
        lower_row=lower_row,
        upper_origins=upper_origins,
        upper_row=upper_row,
    )


def _link(level: NodeLevel, node: NDArray[np.int64], slot: NDArray[np.int64], child: NDArray[np.int64]) -> None:
    """Store the offsets of children in slots."""
    # A value may be longer than an offset, so the slot is cleared first.
    level.values[node, slot] = np.zeros(level.layout.background.shape, level.layout.background.base)
    level.child_offsets[node, slot] = child - (level.begin + node * level.size)
    np.bitwise_or.at(level.child_mask, (node, slot >> 3), (1 << (slot & 7)).astype(np.uint8))


def _active_tiles(
    level: NodeLevel, rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[Any]]:
    """Node, slot and value of the active tiles of some nodes, whose slots with children become inactive."""
    masks = level.value_mask[rows] & ~level.child_mask[rows]
    level.value_mask[rows] = masks
    node, slot = set_bits(masks)
    return rows[node], slot, level.values[rows[node], slot]


def write_statistics(level: NodeLevel, origins: NDArray[np.int32], items: Items) -> None:
    """Write box, flag, minimum and maximum of the nodes."""
    some = items.some()
    # Readers take a node's origin from its box, so an empty box starts at the origin too, and ends before it.
    empty = np.stack([origins, np.full_like(origins, np.iinfo(np.int32).min)], axis=1)
    level.column(("<i4", 3), 0, 2)[:] = np.where(some[:, None, None], items.boxes, empty)
    level.column("<u8", 24, 1)[:, 0] = np.where(some, FLAG_HAS_BBOX, 0)
    limits = level.limits
    limits[some, 0], limits[some, 1] = items.low[some], items.high[some]


def _fill(
    level: NodeLevel, tree: TypedTree, nodes: Nodes, row: NDArray[np.int64], origins: NDArray[np.int32]
) -> NDArray[np.int64]:
    """Write the tiles of a level, those of the tree's ``nodes`` and of all others; returns nodes with active ones."""
    tiles = level.values
    if tree.background.tobytes().strip(b"\0"):
        tiles[:] = tree.background
    active = _own(level, tiles, nodes, row)
    fresh = np.flatnonzero(row < 0)
    return _filled(level, tiles, tree, fresh, origins[fresh], active)


def _filled(
    level: NodeLevel,
    tiles: NDArray[Any],
    tree: TypedTree,
    fresh: NDArray[np.int64],
    origins: NDArray[np.int32],
    active: list[int],
) -> NDArray[np.int64]:
    """Fill nodes missing in the tree with the tile that they replace; returns those with active slots."""
    if len(tree.upper.origins) or len(tree.root.origins):
        values, states = tree.tiles_at(origins, below_root=level.span == 8)
        masks = level.value_mask
        for row in np.flatnonzero(states | differs(values, tree.background)):
            tiles[fresh[row]] = values[row]
            masks[fresh[row]] = 255 if states[row] else 0
        active += fresh[states].tolist()
    return np.array(sorted(active), np.int64)


def _own(level: NodeLevel, tiles: NDArray[Any], nodes: Nodes, row: NDArray[np.int64]) -> list[int]:
    """Copy the tiles of nodes that the tree has; returns the nodes with active tiles."""
    old = np.flatnonzero(row >= 0)
    masks = level.value_mask
    for node in old:
        tiles[node] = nodes.values[row[node]]
        masks[node] = np.packbits(nodes.active[row[node]], bitorder="little")
    return [int(node) for node in old if nodes.active[row[node]].any()]


def write_leaves(leaf: NodeLevel, tree: TypedTree, leaf_order: NDArray[np.int64]) -> tuple[Items, int]:
    """Write a tree's leaves in some order; returns their items and the number of active voxels."""
    layout = leaf.layout
    items = Items.empty(layout, leaf.count)
    first_voxel, extent, flag = leaf.column("<i4", 0, 3), leaf.column(np.uint8, 12, 3), leaf.column(np.uint8, 15, 1)

    def write(first: int) -> int:
        part = slice(first, min(first + LEAVES_AT_A_TIME, leaf.count))
        order = leaf_order[part]
        masks, values, origins = tree.masks[order], tree.values[order], tree.origins[order]
        leaf.value_mask[part] = masks
        if layout.name == "bool":
            leaf.bits[part] = np.packbits(values, axis=1, bitorder="little")
        elif layout.name != "mask":
            leaf.values[part] = values
        active = items_of_leaves(layout, origins, masks, values, items, part)
        some = items.some(part)
        boxes = items.boxes[part]
        first_voxel[part] = np.where(some[:, None], boxes[:, 0], origins)
        extent[part] = np.where(some[:, None], boxes[:, 1] - boxes[:, 0], 0)
        flag[part, 0] = np.where(some, FLAG_HAS_BBOX, 0)
        if layout.leaf_bits > 1:
            limits = np.stack([items.low[part], items.high[part]], axis=1)
            limits[~some] = 0
            leaf.limits[part] = limits
        return active

    if leaf.count <= LEAVES_AT_A_TIME:
        return items, write(0)
    # NumPy releases the GIL in most of these passes.
    return items, sum(pool().map(write, range(0, leaf.count, LEAVES_AT_A_TIME)))


def _write_root(
    grid: GridNodes,
    tree: TypedTree,
    keys: NDArray[np.uint64],
    kept: NDArray[np.int64],
    tile_keys: NDArray[np.uint64],
    items: Items,
) -> None:
    root = grid.root
    grid.entry_count[0] = len(keys) + len(kept)
    table = grid.table
    rank = np.argsort(np.argsort(np.concatenate([keys, tile_keys[kept]])))
    table["value"] = grid.background[...] = tree.background
    table["key"][rank] = np.concatenate([keys, tile_keys[kept]])
    table["child"][rank[: len(keys)]] = grid.upper.starts - root.begin
    table["value"][rank[len(keys) :]] = tree.root.values[kept]
    table["state"][rank[len(keys) :]] = tree.root.active[kept]
    box = root.column(("<i4", 3), 0, 2)[0]
    box[0], box[1] = np.iinfo(np.int32).max, np.iinfo(np.int32).min
    root.limits[:] = tree.background if tree.layout.leaf_bits > 1 else False
    some = bool(items.some()[0])
    if some:
        box[:] = items.boxes[0]
        root.limits[0] = items.low[0], items.high[0]
    root_span(root.buffer, box if some else None)


def write_heads(
    buffer: NDArray[np.uint8],
    head: GridHead,
    begins: tuple[int, int, int, int],
    counts: tuple[int, int, int],
    tree_end: int,
) -> None:
    grid, tree, layout = grid_header(buffer), tree_header(buffer), head.layout
    if head.header is None:
        write_header(buffer, layout, head.options, len(buffer), begins, counts)
    else:
        buffer[:TREE_OFFSET] = head.header
        tree["node_offset"] = [begin - TREE_OFFSET for begin in begins]
        tree["node_count"] = counts
    grid["grid_type"] = GRID_TYPES.index(layout.name)
    grid["flags"] = (
        FLAG_BREADTH_FIRST
        | (FLAG_HAS_MIN_MAX if layout.leaf_bits > 1 else 0)
        | (FLAG_LONG_NAME if head.has_long_name else 0)
    )
    grid["grid_index"], grid["grid_count"], grid["grid_size"] = 0, 1, len(buffer)
    grid["blind_offset"], grid["blind_count"] = tree_end, int(head.has_long_name)


def name_block(head: GridHead) -> NDArray[np.uint8]:
    """A name too long for the header as a block of blind data; blind data of other programs is not kept."""
    if not head.has_long_name:
        return np.empty(0, np.uint8)
    text = head.options.name + b"\0"
    block = np.zeros(BLIND_DATA.itemsize + len(text), np.uint8)
    entry = block[: BLIND_DATA.itemsize].view(BLIND_DATA)[0]
    entry["offset"], entry["value_count"], entry["value_size"] = BLIND_DATA.itemsize, len(text), 1
    entry["data_class"], entry["name"] = BLIND_CLASS_NAME, b"grid name"
    block[BLIND_DATA.itemsize :] = np.frombuffer(text, np.uint8)
    return block
