"""Writer of NanoVDB grids of any value type, from their leaves and tiles, on the host: one, or many at once.

All but the tables of nodes and the copies into each grid's own buffer is computed for all grids together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
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
    GRID_DATA,
    HEAD_SIZE,
    TREE_DATA,
    TREE_OFFSET,
    aligned_buffer,
    grid_header,
    info_of,
    write_header,
)
from geokit.volume.nanovdb.layout import ALIGNMENT, GRID_TYPES, LAYOUTS
from geokit.volume.nanovdb.nodes import NodeLevel, grid_nodes, root_origins, set_bits, slot_of, slot_places
from geokit.volume.tree.grid_head import GridHead, head_like, root_keys_of, root_spans
from geokit.volume.tree.statistics import Items, add_items, items_of_leaves, items_of_tiles, reduced
from geokit.volume.tree.typed_tree import TypedTree, differs, tree_of

# Types of small integers that OpenVDB lacks.
WIDENED = ("int16", "uint8")

# Leaves that a thread processes at a time: 256 of them are half a megabyte of floats, which stays in the cache.
LEAVES_AT_A_TIME = 256


class Tiles(NamedTuple):
    """Tiles of one size: grid (T,), first voxels (T, 3), values (T,) or (T, C), and whether they are active (T,)."""

    grid: NDArray[np.int64]
    origins: NDArray[np.int32]
    values: NDArray[Any]
    active: NDArray[np.bool_]

    def rows(self, kept: Any) -> Tiles:
        """Select tiles by a mask, a slice or indices."""
        return Tiles(self.grid[kept], self.origins[kept], self.values[kept], self.active[kept])


@dataclass(frozen=True)
class _Nodes:
    """Nodes of one level of all grids: their heads (tables left out), and what stands in their slots.

    Attributes:
        heads: Bytes of each node before its table.
        children: Slot of each child, in the order of the level below.
        child_node: Node of each child.
        tile_ends: Tiles of the nodes up to each node.
        tiles: Slot and value of each tile.
        fills: Rows of nodes, and values (N, slots), or (N, 1), that stand in their slots before tiles and children.
        items: Boxes and extrema.
        active: Node of each active tile.
    """

    heads: NDArray[np.uint8]
    children: NDArray[np.int64]
    child_node: NDArray[np.int64]
    tile_ends: NDArray[np.int64]
    tiles: tuple[NDArray[np.int64], NDArray[Any]]
    fills: list[tuple[NDArray[np.int64], NDArray[Any]]]
    items: Items
    active: NDArray[np.int64]


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
    root = tree.root
    if len(root.origins):
        used = np.concatenate([tree.origins, tree.lower.origins, tree.upper.origins])
        root = root.rows(~np.isin(root_keys_of(root.origins), root_keys_of(used)))
    none, tiles = (Tiles(np.zeros(len(part.origins), np.int64), *part) for part in (root.rows(slice(0)), root))
    return next(build_grids(tree, np.zeros(len(tree.origins), np.int64), (none, none, tiles), 1, head))


def build_grids(
    tree: TypedTree, grid_of: NDArray[np.int64], tiles: Sequence[Tiles], count: int, head: GridHead
) -> Iterator[NDArray[np.uint8]]:
    """Build grids from their leaves and tiles.

    Args:
        tree: The leaves of all grids, with the layout and background of ``head``; it has nodes only for one grid alone.
        grid_of: Grid of each leaf, (L,), from 0 to ``count`` - 1. A grid has each place once.
        tiles: Tiles of 8^3, 128^3 and 4096^3 voxels, without children below them.
        count: Number of grids.
        head: Specification of all grids.
    Yields:
        Each grid as ``build_grid`` makes it.
    """
    layout = tree.layout
    nodes_of = ((np.zeros(len(nodes.origins), np.int64), nodes.origins) for nodes in (tree.lower, tree.upper))
    sources = (grid_of, tree.origins), tiles[0][:2], tiles[1][:2], *nodes_of
    (place, small, large, lower_own, upper_own), uppers = _places(*sources)
    order = np.argsort(place, kind="stable")
    place = place[order]
    lower_place = np.unique(np.concatenate([place, small, lower_own]) >> 12)
    lower_upper, upper_origins = lower_place >> 15, root_origins(uppers["root"])
    entries = _entries(tree, uppers, tiles[2])
    grids_of = (grid_of, uppers["grid"][lower_upper], uppers["grid"], entries["grid"])
    numbers = np.stack([np.bincount(grid, minlength=count) for grid in grids_of], axis=1)
    ends = np.cumsum(numbers, axis=0)
    begins = np.full((count, 4), HEAD_SIZE)
    begins[:, 2] += layout.root_size + numbers[:, 3] * layout.root_tile_size
    begins[:, 1] = begins[:, 2] + numbers[:, 2] * layout.upper_size
    begins[:, 0] = begins[:, 1] + numbers[:, 1] * layout.lower_size
    tree_ends = begins[:, 0] + numbers[:, 0] * layout.leaf_size
    name = _name_block(head)
    sizes = -(-(tree_ends + len(name)) // ALIGNMENT) * ALIGNMENT

    # The leaves of one grid alone are written where they stay. Pages are zero until written, so padding costs nothing.
    alone, step = count == 1, layout.leaf_size
    rows = aligned_buffer(int(sizes[0]) if alone else len(order) * step, zeroed=True)
    begin = int(begins[0, 0]) if alone else 0
    leaf = NodeLevel(rows, layout, "leaf", begin, len(order), step, layout.leaf_table, 8, 1)
    items, voxels = _write_leaves(leaf, tree, order)
    lower_origins = upper_origins[lower_upper] + 128 * slot_places(lower_place & 0x7FFF, 32)
    lower = _level(tree, "lower", lower_place, lower_origins, items, place, tiles[0], small, lower_own >> 12)
    upper_place = np.arange(len(uppers))
    upper = _level(
        tree, "upper", upper_place, upper_origins, lower.items, lower_place, tiles[1], large >> 12, upper_own >> 27
    )
    on = tiles[2].rows(tiles[2].active)
    root_items = items_of_tiles(layout, on.origins, on.values, 4096)
    root_items = reduced(*add_items(upper.items, uppers["grid"], root_items, on.grid), count)
    grids_of_tiles = (grids_of[1][lower.active], grids_of[2][upper.active], on.grid)
    tile_counts = np.stack([np.bincount(grid, minlength=count) for grid in grids_of_tiles], axis=1)
    grids, trees = _heads(head, begins, numbers[:, :3], tree_ends, sizes, root_items)
    trees["tile_count"] = tile_counts
    active = np.bincount(grid_of[order], voxels, count).astype(np.int64)
    trees["voxel_count"] = active + tile_counts @ np.array([8, 128, 4096]) ** 3
    roots = _roots(tree, root_items, numbers[:, 3])
    has_background = bool(tree.background.tobytes().strip(b"\0"))

    for number in range(count):
        buffer = rows if alone else aligned_buffer(int(sizes[number]), zeroed=True)
        buffer[int(tree_ends[number]) :][: len(name)] = name
        buffer[:TREE_OFFSET] = grids[number : number + 1].view(np.uint8)
        buffer[TREE_OFFSET:HEAD_SIZE] = trees[number : number + 1].view(np.uint8)
        buffer[HEAD_SIZE:][: layout.root_size] = roots[number]
        grid = grid_nodes(buffer, layout)
        leaf_part, lower_part, upper_part, own = map(slice, (ends - numbers)[number].tolist(), ends[number].tolist())
        for column, source in (("key", "root"), ("state", "state"), ("value", "value")):
            grid.table[column] = entries[source][own]
        child = entries["child"][own]
        to_upper = grid.upper.begin - HEAD_SIZE + (child - upper_part.start) * layout.upper_size
        grid.table["child"] = np.where(child >= 0, to_upper, 0)
        for level, target, below, nodes, held in (
            (upper, grid.upper, grid.lower, upper_part, lower_part),
            (lower, grid.lower, grid.leaf, lower_part, leaf_part),
        ):
            target.column(np.uint8, 0, target.table)[:] = level.heads[nodes]
            values = target.values
            if has_background:
                values[:] = tree.background
            for node, contents in level.fills:
                values[node] = contents
            if len(level.tiles[0]) and target.count:
                some = slice(level.tile_ends[nodes.start - 1] if nodes.start else 0, level.tile_ends[nodes.stop - 1])
                at = np.repeat(np.arange(target.count), np.diff(level.tile_ends[nodes], prepend=some.start))
                values[at, level.tiles[0][some]] = level.tiles[1][some]
            node, slot = level.child_node[held] - nodes.start, level.children[held]
            # A value may be longer than an offset, so the slot is cleared first.
            values[node, slot] = 0
            target.child_offsets[node, slot] = below.starts - target.begin - node * target.size
        if not alone:
            buffer[grid.leaf.begin : grid.leaf.end] = rows[leaf_part.start * step : leaf_part.stop * step]
        grid_header(buffer)["checksum"] = partial_checksum(buffer[:HEAD_SIZE], buffer)
        buffer.setflags(write=False)
        yield buffer


def _places(*sources: Any) -> tuple[list[NDArray[np.int64]], NDArray[Any]]:
    """Places of the voxels of some sources (grids, voxels); grid and root key of the upper nodes of all grids.

    A place is the number of the upper node, then the slots there and in the lower node: at most 2^36 upper nodes leave
    27 bits for them.
    """
    grids, voxels = map(np.concatenate, zip(*sources, strict=True))
    keys = root_keys_of(voxels)
    order = np.lexsort((keys, grids))
    uppers = np.empty(len(keys), [("grid", np.int64), ("root", np.uint64)])
    uppers["grid"], uppers["root"] = grids[order], keys[order]
    first = np.ones(len(keys), np.bool_)
    first[1:] = uppers[1:] != uppers[:-1]
    upper = np.empty(len(keys), np.int64)
    upper[order] = np.cumsum(first) - 1
    places = upper << 27 | slot_of(voxels, 32, 128) << 12 | slot_of(voxels, 16, 8)
    ends = np.cumsum([len(grid) for grid, _ in sources])
    return np.split(places, ends[:-1]), uppers[first]


def _level(
    tree: TypedTree,
    name: str,
    places: NDArray[np.int64],
    origins: NDArray[np.int32],
    child_items: Items,
    child_place: NDArray[np.int64],
    tiles: Tiles,
    tile_place: NDArray[np.int64],
    own_place: NDArray[np.int64],
) -> _Nodes:
    """Nodes at some places, ascending; a place of a child or tile is that of its node, then its slot.

    Those of the tree stand at ``own_place``; others are filled with the tile that they replace.
    """
    layout = tree.layout
    table, width, span, nodes = (
        (layout.upper_table, 32, 128, tree.upper) if name == "upper" else (layout.lower_table, 16, 8, tree.lower)
    )
    slots = width**3
    child_node, tile_node = (np.searchsorted(places, place // slots) for place in (child_place, tile_place))
    child_slot, tile_slot = child_place % slots, tile_place % slots
    heads = np.zeros((len(places), table), np.uint8)
    masks, child_masks = heads[:, 32 : 32 + slots // 8], heads[:, 32 + slots // 8 : 32 + slots // 4]
    own = np.searchsorted(places, own_place)
    masks[own] = np.packbits(nodes.active, axis=1, bitorder="little")
    fills = [(own, nodes.values)] if len(own) else []
    if len(tree.upper.origins) or len(tree.root.origins):
        fresh = np.delete(np.arange(len(places)), own)
        values, states = tree.tiles_at(origins[fresh], below_root=name == "lower")
        masks[fresh[states]] = 255
        some = states | differs(values, tree.background)
        fills.append((fresh[some], values[some, None]))
    np.bitwise_or.at(child_masks, (child_node, child_slot >> 3), (1 << (child_slot & 7)).astype(np.uint8))
    masks &= ~child_masks
    on = tiles.rows(tiles.active)
    active = [(tile_node[tiles.active], on.origins, on.values)] if len(tile_place) else []
    for rows, contents in fills:
        node, slot = set_bits(masks[rows])
        contents = np.broadcast_to(contents, (len(rows), slots, *contents.shape[2:]))
        active.append((rows[node], origins[rows[node]] + span * slot_places(slot, width), contents[node, slot]))
    np.bitwise_or.at(masks, (tile_node, tile_slot >> 3), (tiles.active << (tile_slot & 7)).astype(np.uint8))
    items, parent = child_items, child_node
    for node, corners, values in active:
        items, parent = add_items(items, parent, items_of_tiles(layout, corners, values, span), node)
    items = reduced(items, parent, len(places))
    level = NodeLevel(heads.reshape(-1), layout, name, 0, len(places), table, table, width, span)
    _write_statistics(level, origins, items)
    order = np.argsort(tile_node, kind="stable")
    return _Nodes(
        heads=heads,
        children=child_slot,
        child_node=child_node,
        tile_ends=np.cumsum(np.bincount(tile_node, minlength=len(places))),
        tiles=(tile_slot[order], tiles.values[order]),
        fills=fills,
        items=items,
        active=parent[len(child_node) :],
    )


def _write_statistics(level: NodeLevel, origins: NDArray[np.int32], items: Items) -> None:
    """Write box, flag, minimum and maximum of the nodes."""
    some = items.some()
    # Readers take a node's origin from its box, so an empty box starts at the origin too, and ends before it.
    empty = np.stack([origins, np.full_like(origins, np.iinfo(np.int32).min)], axis=1)
    level.column(("<i4", 3), 0, 2)[:] = np.where(some[:, None, None], items.boxes, empty)
    level.column("<u8", 24, 1)[:, 0] = np.where(some, FLAG_HAS_BBOX, 0)
    limits = level.limits
    limits[some, 0], limits[some, 1] = items.low[some], items.high[some]


def _write_leaves(leaf: NodeLevel, tree: TypedTree, leaf_order: NDArray[np.int64]) -> tuple[Items, NDArray[np.int64]]:
    """Write a tree's leaves in some order; returns their items and numbers of active voxels."""
    layout = leaf.layout
    items = Items.empty(layout.background, leaf.count)
    first_voxel, extent, flag = leaf.column("<i4", 0, 3), leaf.column(np.uint8, 12, 3), leaf.column(np.uint8, 15, 1)

    def write(first: int) -> NDArray[np.int64]:
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
    return items, np.concatenate(list(pool().map(write, range(0, leaf.count, LEAVES_AT_A_TIME))))


def _entries(tree: TypedTree, uppers: NDArray[Any], tiles: Tiles) -> NDArray[Any]:
    """Entries of the root tables of all grids, in order."""
    kind = [("grid", np.int64), ("root", np.uint64), ("child", np.int64), ("state", np.uint32)]
    entries = np.zeros(len(uppers) + len(tiles.grid), [*kind, ("value", tree.layout.background)])
    entries["value"] = tree.background
    entries["grid"] = np.concatenate([uppers["grid"], tiles.grid])
    entries["root"] = np.concatenate([uppers["root"], root_keys_of(tiles.origins)])
    entries["child"] = np.concatenate([np.arange(len(uppers)), np.full(len(tiles.grid), -1)])
    entries["state"][len(uppers) :] = tiles.active
    entries["value"][len(uppers) :] = tiles.values
    return entries[np.lexsort((entries["root"], entries["grid"]))]


def _heads(
    head: GridHead,
    begins: NDArray[np.int64],
    numbers: NDArray[np.int64],
    tree_ends: NDArray[np.int64],
    sizes: NDArray[np.int64],
    items: Items,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Headers of all grids and of their trees."""
    template, layout = aligned_buffer(HEAD_SIZE, zeroed=True), head.layout
    if head.header is None:
        write_header(template, layout, head.options, 0, 4 * (TREE_OFFSET,), (0, 0, 0))
    else:
        template[:TREE_OFFSET] = head.header
    grids = np.repeat(template[:TREE_OFFSET].view(GRID_DATA), len(sizes))
    trees = np.zeros(len(sizes), TREE_DATA)
    trees["node_offset"], trees["node_count"] = begins - TREE_OFFSET, numbers
    grids["grid_type"] = GRID_TYPES.index(layout.name)
    grids["flags"] = (
        FLAG_BREADTH_FIRST
        | (FLAG_HAS_MIN_MAX if layout.leaf_bits > 1 else 0)
        | (FLAG_LONG_NAME if head.has_long_name else 0)
    )
    grids["grid_index"], grids["grid_count"], grids["grid_size"] = 0, 1, sizes
    grids["blind_offset"], grids["blind_count"] = tree_ends, int(head.has_long_name)
    root_spans(grids, items.boxes)
    return grids, trees


def _roots(tree: TypedTree, items: Items, entry_counts: NDArray[np.int64]) -> NDArray[np.uint8]:
    """The roots of all grids without their tables."""
    layout, kind = tree.layout, tree.layout.background
    roots = np.zeros((len(entry_counts), layout.root_size), np.uint8)
    roots[:, :24] = items.boxes.reshape(-1, 6).view(np.uint8)
    roots[:, 24:28] = entry_counts.astype("<u4")[:, None].view(np.uint8)
    limits = np.empty((len(roots), 3, *kind.shape), kind.base)
    limits[:] = tree.background
    if layout.leaf_bits <= 1:
        limits[:, 1:] = False
    some = items.some()
    limits[some, 1], limits[some, 2] = items.low[some], items.high[some]
    at = layout.root_background
    roots[:, at : at + 3 * kind.itemsize] = limits.reshape(len(roots), -1).view(np.uint8)
    return roots


def _name_block(head: GridHead) -> NDArray[np.uint8]:
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
