"""Conversion of a grid's tree to another value type: the same nodes in the same order, with room for new leaves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.header import (
    FLAG_HAS_MIN_MAX,
    HEAD_SIZE,
    TREE_OFFSET,
    aligned_buffer,
    grid_header,
    tree_header,
)
from geokit.volume.nanovdb.layout import layout_of, type_name
from geokit.volume.nanovdb.nodes import GridNodes, NodeLevel, bits_of, grid_nodes, set_bits


@dataclass(frozen=True)
class RetypedTree:
    """A grid of another type whose leaves are still to be filled.

    Attributes:
        buffer: The grid, uint8, 32-byte aligned. Leaves are zero; the checksum and the nodes' extrema are those of the
            source.
        leaf_starts: Offset of each leaf, shape (L,), in the order of the source's leaves.
        lower_of_leaf: Lower node of each leaf, shape (L,).
        upper_of_lower: Upper node of each lower node.
    """

    buffer: NDArray[np.uint8]
    leaf_starts: NDArray[np.int64]
    lower_of_leaf: NDArray[np.int64]
    upper_of_lower: NDArray[np.int64]

    def write_extrema(self, low: NDArray[np.float32], high: NDArray[np.float32]) -> None:
        """Write the smallest and the largest active value of every node above the leaves.

        Args:
            low: Smallest active value of each leaf, inf if none is active.
            high: Largest active value of each leaf, -inf if none is active.
        """
        grid = grid_nodes(self.buffer)
        for level, parent in ((grid.lower, self.lower_of_leaf), (grid.upper, self.upper_of_lower)):
            below = np.full(level.count, np.inf, np.float32), np.full(level.count, -np.inf, np.float32)
            np.minimum.at(below[0], parent, low)
            np.maximum.at(below[1], parent, high)
            low, high = below
            for first, part in level.parts():
                node, slot = set_bits(part.tile_mask)
                np.minimum.at(low, node + first, part.values[node, slot])
                np.maximum.at(high, node + first, part.values[node, slot])
            some, limits = low <= high, level.limits
            limits[some, 0], limits[some, 1] = low[some], high[some]
        tiles = grid.table["value"][(grid.table["child"] == 0) & (grid.table["state"] != 0)]
        least, most = np.append(low, tiles), np.append(high, tiles)
        if len(least) and least.min() <= most.max():
            grid.root.limits[0] = least.min(), most.max()
        grid_header(self.buffer)["flags"] |= FLAG_HAS_MIN_MAX


def tile_values(buffer: NDArray[np.uint8]) -> NDArray[Any]:
    """Background and values of all tiles of a structurally valid grid, in no particular order."""
    grid = grid_nodes(buffer)
    parts = [grid.background.reshape(1).copy(), grid.table["value"][grid.table["child"] == 0]]
    for level in (grid.lower, grid.upper):
        for _, part in level.parts():
            parts.append(np.unique(part.values[~bits_of(part.child_mask)]))
    return np.concatenate(parts)


def retype_tree(
    buffer: NDArray[np.uint8], grid_type: int, leaf_sizes: NDArray[np.int64], channel: NDArray[Any] | None = None
) -> RetypedTree:
    """Copy a grid except its leaves into a grid of another type.

    Args:
        buffer: A structurally valid grid of a scalar floating-point type, whose values are rounded to the new one; or
            an index grid.
        grid_type: NanoVDB's code of the new type.
        leaf_sizes: Bytes of each leaf of the new grid, shape (L,).
        channel: Values to which the indices of an index grid refer, shape (count,) or (count, C). Statistics and blind
            data of an index grid are left out, since they describe the indices.
    """
    old, new = grid_nodes(buffer), layout_of(grid_type, type_name(grid_type))
    upper_begin = HEAD_SIZE + new.root_size + len(old.table) * new.root_tile_size
    lower_begin = upper_begin + old.upper.count * new.upper_size
    leaf_begin = lower_begin + old.lower.count * new.lower_size
    starts = leaf_begin + np.concatenate([[0], np.cumsum(leaf_sizes)]).astype(np.int64)
    # Offsets of blind data count from its entries, so that entries and data can move together.
    head = grid_header(buffer)
    blind = buffer[int(head["blind_offset"]) :] if channel is None and head["blind_count"] else buffer[:0]
    out = aligned_buffer(int(starts[-1]) + len(blind), zeroed=True)
    _write_heads(out, buffer, grid_type, (leaf_begin, lower_begin, upper_begin, HEAD_SIZE), int(starts[-1]), blind)
    target = grid_nodes(out)
    _copy_root(target, old, channel)
    upper_of_lower = _copy_nodes(target.upper, old.upper, old.lower.starts, target.lower.starts, channel)
    lower_of_leaf = _copy_nodes(target.lower, old.lower, old.leaf.starts, starts[:-1], channel)
    return RetypedTree(out, starts[:-1], lower_of_leaf, upper_of_lower)


def _write_heads(
    out: NDArray[np.uint8],
    buffer: NDArray[np.uint8],
    grid_type: int,
    begins: tuple[int, ...],
    tree_end: int,
    blind: NDArray[np.uint8],
) -> None:
    out[:HEAD_SIZE] = buffer[:HEAD_SIZE]
    grid, tree = grid_header(out), tree_header(out)
    grid["grid_type"], grid["grid_size"] = grid_type, len(out)
    tree["node_offset"] = [begin - TREE_OFFSET for begin in begins]
    if int(grid["blind_count"]) or int(grid["blind_offset"]):
        grid["blind_offset"] = tree_end
    out[tree_end:] = blind


def _copy_root(target: GridNodes, source: GridNodes, channel: NDArray[Any] | None) -> None:
    target.root.column(np.uint8, 0, 28)[:] = source.root.column(np.uint8, 0, 28)
    new, old = target.table, source.table
    new["key"], new["state"] = old["key"], old["state"]
    has_child = old["child"] != 0
    node = (old["child"] + source.root.begin - source.upper.begin) // source.upper.size
    start = target.upper.begin + node * target.upper.size - target.root.begin
    new["child"] = np.where(has_child, start, 0)
    if channel is None:
        new["value"] = old["value"]
        with np.errstate(over="ignore"):
            target.background[...] = source.background
        _copy_statistics(target.root, source.root)
    else:
        new["value"][~has_child] = channel[old["value"][~has_child]]
        target.background[...] = channel[source.background]


@np.errstate(over="ignore")
def _copy_statistics(target: NodeLevel, source: NodeLevel) -> None:
    target.limits[:], target.moments[:] = source.limits, source.moments


def _copy_nodes(
    target: NodeLevel,
    source: NodeLevel,
    old_starts: NDArray[np.int64],
    new_starts: NDArray[np.int64],
    channel: NDArray[Any] | None,
) -> NDArray[np.int64]:
    """Copy boxes, masks, statistics and slots of a level; returns the node of each child."""
    parent = np.empty(len(old_starts), np.int64)
    head = 32 + 2 * source.slots // 8
    if channel is None:
        _copy_statistics(target, source)
    for (first, old), (_, new) in zip(source.parts(), target.parts(), strict=True):
        new.column(np.uint8, 0, head)[:] = old.column(np.uint8, 0, head)
        if channel is None:
            with np.errstate(over="ignore", invalid="ignore"):  # a slot with a child holds no value
                new.values[:] = old.values
        else:
            is_tile = ~bits_of(old.child_mask)
            new.values[is_tile] = channel[old.values[is_tile]]
        node, slot, start = old.links()
        child = np.searchsorted(old_starts, start)
        parent[child] = node + first
        new.child_offsets[node, slot] = new_starts[child] - (new.begin + node * new.size)
    return parent
