"""Writer of many small grids of one type at once: the same bytes as ``typed_writer`` gives, in a tenth of the time.

Everything but the copies into each grid's own buffer is computed for all grids together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.checksum import partial_checksum
from geokit.volume.nanovdb.header import FLAG_HAS_BBOX, GRID_DATA, HEAD_SIZE, TREE_DATA, TREE_OFFSET, aligned_buffer
from geokit.volume.nanovdb.layout import ALIGNMENT, LOWER_SLOTS, UPPER_SLOTS
from geokit.volume.nanovdb.nodes import NodeLevel, grid_nodes, root_origins, slot_of
from geokit.volume.tree.grid_head import GridHead
from geokit.volume.tree.root_table import root_keys_of
from geokit.volume.tree.statistics import NO_BOX, Items, add_items, items_of_tiles, reduced
from geokit.volume.tree.typed_tree import TypedTree
from geokit.volume.tree.typed_writer import name_block, write_heads, write_leaves, write_statistics

__all__ = ["Tiles", "build_grids"]


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
        ends: Nodes of the grids up to each.
        origins: First voxel of each node.
        heads: Bytes of each node before its table.
        children: Slot of each child, in the order of the level below.
        child_node: Node of each child.
        tile_ends: Tiles of the nodes up to each node.
        tiles: Slot and value of each tile.
        items: Boxes and extrema.
        tile_counts: Active tiles of each grid.
    """

    ends: NDArray[np.int64]
    origins: NDArray[np.int32]
    heads: NDArray[np.uint8]
    children: NDArray[np.int64]
    child_node: NDArray[np.int64]
    tile_ends: NDArray[np.int64]
    tiles: tuple[NDArray[np.int64], NDArray[Any]]
    items: Items
    tile_counts: NDArray[np.int64]


def build_grids(
    tree: TypedTree, grid_of: NDArray[np.int64], tiles: Sequence[Tiles], count: int, head: GridHead
) -> Iterator[NDArray[np.uint8]]:
    """Build grids from their leaves and tiles.

    Args:
        tree: The leaves of all grids, with the layout and background of ``head``; its nodes and tiles are not used.
        grid_of: Grid of each leaf, (L,), from 0 to ``count`` - 1. A grid has each place once.
        tiles: Tiles of 8^3, 128^3 and 4096^3 voxels, without children below them.
        count: Number of grids.
        head: Specification of all grids.
    Yields:
        Each grid as ``build_grid`` makes it.
    """
    layout, background = tree.layout, tree.background
    leaf_uppers, tile_uppers, upper_keys = _uppers(tree.origins, grid_of, tiles)
    place = leaf_uppers << 27 | slot_of(tree.origins, 32, 128) << 12 | slot_of(tree.origins, 16, 8)
    order = np.argsort(place, kind="stable")
    place = place[order]
    rows = np.zeros((len(order), layout.leaf_size), np.uint8)
    leaf = NodeLevel(rows.reshape(-1), layout, "leaf", 0, len(order), layout.leaf_size, layout.leaf_table, 8, 1)
    items, _ = write_leaves(leaf, tree, order)
    ends = np.cumsum(np.bincount(grid_of, minlength=count))
    voxels = np.bincount(grid_of, np.unpackbits(tree.masks, axis=1).sum(axis=1), count).astype(np.int64)

    tile_place = tile_uppers[0] << 15 | slot_of(tiles[0].origins, 32, 128)
    lower_place = np.unique(np.concatenate([place >> 12, tile_place]))
    own = np.concatenate([tree.origins[order], tiles[0].origins]) & ~np.int32(127)
    children = place >> 12, place & 0xFFF, tile_place
    places = np.concatenate([place >> 12, tile_place])
    lower = _level(head, count, lower_place, upper_keys, items, children, tiles[0], own, places, False)
    upper_place = np.arange(len(upper_keys))
    own = root_origins(upper_keys["root"])
    children = lower_place >> 15, lower_place & 0x7FFF, tile_uppers[1]
    upper = _level(head, count, upper_place, upper_keys, lower.items, children, tiles[1], own, upper_place, True)
    on = tiles[2].rows(tiles[2].active)
    root_items = items_of_tiles(layout, on.origins, on.values, 4096)
    root_items = reduced(*add_items(upper.items, upper_keys["grid"], root_items, on.grid), count)
    root_tiles = np.bincount(on.grid, minlength=count)
    for counts, span in ((lower.tile_counts, 8), (upper.tile_counts, 128), (root_tiles, 4096)):
        voxels += counts * span**3
    entries = _entries(tree, upper_keys, tiles[2])
    entry_ends = np.cumsum(np.bincount(entries["grid"], minlength=count))

    numbers = np.stack([np.diff(part, prepend=0) for part in (ends, lower.ends, upper.ends)], axis=1)
    entry_counts = np.diff(entry_ends, prepend=0)
    begins = np.empty((count, 4), np.int64)
    begins[:, 3] = HEAD_SIZE
    begins[:, 2] = HEAD_SIZE + layout.root_size + entry_counts * layout.root_tile_size
    begins[:, 1] = begins[:, 2] + numbers[:, 2] * layout.upper_size
    begins[:, 0] = begins[:, 1] + numbers[:, 1] * layout.lower_size
    tree_ends = begins[:, 0] + numbers[:, 0] * layout.leaf_size
    name = name_block(head)
    sizes = -(-(tree_ends + len(name)) // ALIGNMENT) * ALIGNMENT
    grids, trees = _heads(head, begins, numbers, tree_ends, sizes, root_items)
    trees["tile_count"] = np.stack([lower.tile_counts, upper.tile_counts, root_tiles], axis=1)
    trees["voxel_count"] = voxels
    roots = _roots(tree, root_items, entry_counts)
    has_background = bool(background.tobytes().strip(b"\0"))

    for number in range(count):
        buffer = aligned_buffer(int(sizes[number]), zeroed=True)
        buffer[int(tree_ends[number]) :][: len(name)] = name
        buffer[:TREE_OFFSET] = grids[number : number + 1].view(np.uint8)
        buffer[TREE_OFFSET:HEAD_SIZE] = trees[number : number + 1].view(np.uint8)
        buffer[HEAD_SIZE:][: layout.root_size] = roots[number]
        grid, own = grid_nodes(buffer, layout), _part(entry_ends, number)
        grid.table["key"], grid.table["state"], grid.table["value"] = (
            entries[k][own] for k in ("root", "state", "value")
        )
        child = entries["child"][own]
        first = upper.ends[number - 1] if number else 0
        grid.table["child"] = np.where(
            child >= 0, grid.upper.begin - HEAD_SIZE + (child - first) * layout.upper_size, 0
        )
        for level, target, below, child_ends in (
            (upper, grid.upper, grid.lower, lower.ends),
            (lower, grid.lower, grid.leaf, ends),
        ):
            nodes = _part(level.ends, number)
            target.column(np.uint8, 0, target.table)[:] = level.heads[nodes]
            values = target.values
            if has_background:
                values[:] = background
            if len(level.tiles[0]) and target.count:
                some = slice(level.tile_ends[nodes.start - 1] if nodes.start else 0, level.tile_ends[nodes.stop - 1])
                at = np.repeat(np.arange(target.count), np.diff(level.tile_ends[nodes], prepend=some.start))
                values[at, level.tiles[0][some]] = level.tiles[1][some]
            held = _part(child_ends, number)
            node, slot = level.child_node[held] - nodes.start, level.children[held]
            values[node, slot] = 0
            target.child_offsets[node, slot] = below.starts - target.begin - node * target.size
        buffer[grid.leaf.begin : grid.leaf.end] = rows[_part(ends, number)].reshape(-1)
        buffer[8:16].view("<u8")[0] = partial_checksum(buffer[:HEAD_SIZE], buffer)
        buffer.setflags(write=False)
        yield buffer


def _part(ends: NDArray[np.int64], number: int) -> slice:
    return slice(int(ends[number - 1]) if number else 0, int(ends[number]))


def _uppers(
    origins: NDArray[np.int32], grid_of: NDArray[np.int64], tiles: Sequence[Tiles]
) -> tuple[NDArray[np.int64], tuple[NDArray[np.int64], NDArray[np.int64]], NDArray[Any]]:
    """Upper node of each leaf and of each smaller tile, and grid and root key of the upper nodes of all grids."""
    sources = ((grid_of, origins), (tiles[0].grid, tiles[0].origins), (tiles[1].grid, tiles[1].origins))
    keys = np.empty(sum(len(grid) for grid, _ in sources), [("grid", np.int64), ("root", np.uint64)])
    keys["grid"] = np.concatenate([grid for grid, _ in sources])
    keys["root"] = np.concatenate([root_keys_of(part) for _, part in sources])
    roots, rank = np.unique(keys["root"], return_inverse=True)
    _, first, node = np.unique(
        keys["grid"] * max(len(roots), 1) + rank.reshape(-1), return_index=True, return_inverse=True
    )
    ends = np.cumsum([len(grid) for grid, _ in sources])
    leaf, small, large = np.split(node.reshape(-1), ends[:-1])
    return leaf, (small, large), keys[first]


def _level(
    head: GridHead,
    count: int,
    places: NDArray[np.int64],
    uppers: NDArray[Any],
    child_items: Items,
    children: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
    tiles: Tiles,
    origins: NDArray[np.int32],
    origin_places: NDArray[np.int64],
    is_upper: bool,
) -> _Nodes:
    layout = head.layout
    child_place, child_slot, tile_place = children
    slots, width, span = (UPPER_SLOTS, 32, 128) if is_upper else (LOWER_SLOTS, 16, 8)
    table = layout.upper_table if is_upper else layout.lower_table
    child_node, tile_node = np.searchsorted(places, child_place), np.searchsorted(places, tile_place)
    tile_slot = slot_of(tiles.origins, width, span)
    order = np.argsort(tile_node, kind="stable")
    on = tiles.active
    tile_items = items_of_tiles(layout, tiles.origins[on], tiles.values[on], span)
    items = reduced(*add_items(child_items, child_node, tile_items, tile_node[on]), len(places))
    heads = np.zeros((len(places), table), np.uint8)
    bytes_of = heads[:, 32:]
    np.bitwise_or.at(bytes_of, (tile_node[on], tile_slot[on] >> 3), (1 << (tile_slot[on] & 7)).astype(np.uint8))
    at = slots // 8 + (child_slot >> 3)
    np.bitwise_or.at(bytes_of, (child_node, at), (1 << (child_slot & 7)).astype(np.uint8))
    first = np.empty((len(places), 3), np.int32)
    first[np.searchsorted(places, origin_places)] = origins
    name = "upper" if is_upper else "lower"
    nodes = NodeLevel(heads.reshape(-1), layout, name, 0, len(places), table, table, width, span)
    write_statistics(nodes, first, items)
    grid = uppers["grid"][places if is_upper else places >> 15]
    return _Nodes(
        ends=np.cumsum(np.bincount(grid, minlength=count)),
        origins=first,
        heads=heads,
        children=child_slot,
        child_node=child_node,
        tile_ends=np.cumsum(np.bincount(tile_node, minlength=len(places))),
        tiles=(tile_slot[order], tiles.values[order]),
        items=items,
        tile_counts=np.bincount(tiles.grid[on], minlength=count),
    )


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
    template = aligned_buffer(HEAD_SIZE, zeroed=True)
    write_heads(template, head, 4 * (TREE_OFFSET,), (0, 0, 0), 0)
    grids = np.repeat(template[:TREE_OFFSET].view(GRID_DATA), len(sizes))
    trees = np.repeat(template[TREE_OFFSET:].view(TREE_DATA), len(sizes))
    trees["node_offset"], trees["node_count"] = begins - TREE_OFFSET, numbers
    grids["grid_size"], grids["blind_offset"] = sizes, tree_ends
    some = items.some()
    limits = np.finfo(np.float64)
    grids["world_bbox"] = [limits.max] * 3 + [limits.min] * 3
    ends = items.boxes[some].astype(np.float64) + np.array([[0.0], [1.0]])
    corner = np.array(np.meshgrid(*3 * [[0, 1]], indexing="ij")).reshape(3, -1)
    corners = ends[:, corner, np.arange(3)[:, None]]
    world = grids["matrix"][0].reshape(3, 3) @ corners + grids["vector"][0][:, None]
    grids["world_bbox"][some] = np.concatenate([world.min(axis=2), world.max(axis=2)], axis=1)
    grids["flags"][some] |= FLAG_HAS_BBOX
    return grids, trees


def _roots(tree: TypedTree, items: Items, entry_counts: NDArray[np.int64]) -> NDArray[np.uint8]:
    """The roots of all grids without their tables."""
    layout, kind = tree.layout, tree.layout.background
    roots = np.zeros((len(entry_counts), layout.root_size), np.uint8)
    roots[:, :24] = np.where(items.some()[:, None, None], items.boxes, NO_BOX).reshape(-1, 6).view(np.uint8)
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
