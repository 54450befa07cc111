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
from geokit.volume.nanovdb.index_checks import INDEX_LAYOUTS
from geokit.volume.nanovdb.layout import LEAF_VOXELS, LOWER_SLOTS, UPPER_SLOTS, GridLayout, layout_of, type_name
from geokit.volume.tree.root_table import root_tile_type

__all__ = ["RetypedTree", "leaf_starts", "retype_tree", "tile_values"]

# Nodes copied at a time: 64 upper nodes are 16 MiB.
NODES_AT_A_TIME = 64


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
        grid, tree = grid_header(self.buffer), tree_header(self.buffer)
        layout = layout_of(int(grid["grid_type"]), "grid")
        for level, parent, slots, table, size in (
            (1, self.lower_of_leaf, LOWER_SLOTS, layout.lower_table, layout.lower_size),
            (2, self.upper_of_lower, UPPER_SLOTS, layout.upper_table, layout.upper_size),
        ):
            nodes = _Nodes(self.buffer, TREE_OFFSET + int(tree["node_offset"][level]), int(tree["node_count"][level]),
                           size, slots, table, layout)  # fmt: skip
            below = np.full(nodes.count, np.inf, np.float32), np.full(nodes.count, -np.inf, np.float32)
            np.minimum.at(below[0], parent, low)
            np.maximum.at(below[1], parent, high)
            nodes.add_tiles(*below)
            low, high = below
            _write_limits(nodes.statistics(), low, high)
        root = TREE_OFFSET + int(tree["node_offset"][3])
        count = int(self.buffer[root + 24 : root + 28].view("<u4")[0])
        rows = self.buffer[root + layout.root_size :][: count * layout.root_tile_size].view(root_tile_type(layout))
        tiles = rows["value"][(rows["child"] == 0) & (rows["state"] != 0)]
        least, most = np.append(low, tiles), np.append(high, tiles)
        if len(least) and least.min() <= most.max():
            start = root + layout.root_background + layout.background.itemsize
            limits = self.buffer[start : start + 2 * layout.background.itemsize].view(layout.background)
            limits[:] = least.min(), most.max()
        grid["flags"] |= FLAG_HAS_MIN_MAX


@dataclass(frozen=True)
class _Nodes:
    """The nodes of one level above the leaves."""

    buffer: NDArray[np.uint8]
    begin: int
    count: int
    size: int
    slots: int
    table: int
    layout: GridLayout

    def bytes(self) -> NDArray[np.uint8]:
        """Shape (count, size)."""
        return self.buffer[self.begin : self.begin + self.count * self.size].reshape(self.count, self.size)

    def column(self, dtype: Any, offset: int, count: int, step: int) -> NDArray[Any]:
        """``count`` values of each node from ``offset`` on, ``step`` bytes apart; vectors have one more axis."""
        kind = np.dtype(dtype)
        shape = (self.count, count, *kind.shape)
        if not self.count:
            return np.empty(shape, kind.base)
        strides = (self.size, step, *([kind.base.itemsize] * len(kind.shape)))
        return np.ndarray(shape, kind.base, self.buffer, self.begin + offset, strides)

    def tiles(self) -> NDArray[Any]:
        """Contents of the slots, (count, slots) or (count, slots, C); a value unless the slot has a child."""
        return self.column(self.layout.background, self.table, self.slots, self.layout.table_stride)

    def statistics(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Minimum and maximum (count, 2); average and deviation (count, 2)."""
        return _statistics(self, 32 + 2 * self.slots // 8, self.layout)

    def children(self, first: int, stop: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Node and slot of the children of some nodes."""
        mask = self.bytes()[first:stop, 32 + self.slots // 8 : 32 + 2 * self.slots // 8]
        node, slot = np.nonzero(np.unpackbits(mask, axis=1, bitorder="little"))
        return node + first, slot

    def add_tiles(self, low: NDArray[np.float32], high: NDArray[np.float32]) -> None:
        """Include the active tiles of each node in its extrema."""
        part = self.slots // 8
        value = self.tiles()
        for first in range(0, self.count, NODES_AT_A_TIME):
            rows = self.bytes()[first : first + NODES_AT_A_TIME]
            active = rows[:, 32 : 32 + part] & ~rows[:, 32 + part : 32 + 2 * part]
            node, slot = np.nonzero(np.unpackbits(active, axis=1, bitorder="little"))
            np.minimum.at(low, node + first, value[node + first, slot])
            np.maximum.at(high, node + first, value[node + first, slot])


def _statistics(nodes: _Nodes, offset: int, layout: GridLayout) -> tuple[NDArray[Any], NDArray[Any]]:
    value = layout.background.itemsize
    limits = -(-offset // layout.align) * layout.align
    mean = -(-(limits + 2 * value) // layout.stat) * layout.stat
    return nodes.column(layout.background, limits, 2, value), nodes.column(f"<f{layout.stat}", mean, 2, layout.stat)


def _write_limits(statistics: tuple[NDArray[Any], NDArray[Any]], low: Any, high: Any) -> None:
    limits = statistics[0]
    some = low <= high
    limits[some, 0], limits[some, 1] = low[some], high[some]


def leaf_starts(buffer: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Offset of each leaf of a structurally valid grid, ascending, shape (L,)."""
    tree = tree_header(buffer)
    layout = _layout_of(buffer)
    begin, count = TREE_OFFSET + int(tree["node_offset"][0]), int(tree["node_count"][0])
    if layout.leaf_bits >= 0:
        return begin + layout.leaf_size * np.arange(count)
    starts = np.empty(count, np.int64)
    memory = buffer.data
    for i in range(count):
        starts[i] = begin
        # Each leaf stores its own width.
        begin += layout.leaf_header + (LEAF_VOXELS // 8 << (int(memory[begin + 15]) >> 5))
    return starts


def tile_values(buffer: NDArray[np.uint8]) -> NDArray[Any]:
    """Background and values of all tiles of a structurally valid grid, in no particular order."""
    tree = tree_header(buffer)
    layout = layout_of(int(grid_header(buffer)["grid_type"]), "grid")
    root = TREE_OFFSET + int(tree["node_offset"][3])
    size = layout.background.itemsize
    parts = [buffer[root + layout.root_background :][:size].copy().view(layout.background)]
    count = int(buffer[root + 24 : root + 28].view("<u4")[0])
    rows = buffer[root + layout.root_size :][: count * layout.root_tile_size].view(root_tile_type(layout))
    parts.append(rows["value"][rows["child"] == 0])
    for level, slots, table, bytes_each in (
        (1, LOWER_SLOTS, layout.lower_table, layout.lower_size),
        (2, UPPER_SLOTS, layout.upper_table, layout.upper_size),
    ):
        begin = TREE_OFFSET + int(tree["node_offset"][level])
        nodes = _Nodes(buffer, begin, int(tree["node_count"][level]), bytes_each, slots, table, layout)
        values = nodes.tiles()
        for first in range(0, nodes.count, NODES_AT_A_TIME):
            rows = values[first : first + NODES_AT_A_TIME]
            free = np.ones(rows.shape, np.bool_)
            node, slot = nodes.children(first, min(first + NODES_AT_A_TIME, nodes.count))
            free[node - first, slot] = False
            parts.append(np.unique(rows[free]))
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
    old = _layout_of(buffer)
    new = layout_of(grid_type, type_name(grid_type))
    tree = tree_header(buffer)
    begins = [TREE_OFFSET + int(offset) for offset in tree["node_offset"]]
    counts = [int(count) for count in tree["node_count"]]
    tiles = int(buffer[begins[3] + 24 : begins[3] + 28].view("<u4")[0])
    upper_begin = HEAD_SIZE + new.root_size + tiles * new.root_tile_size
    lower_begin = upper_begin + counts[2] * new.upper_size
    leaf_begin = lower_begin + counts[1] * new.lower_size
    starts = leaf_begin + np.concatenate([[0], np.cumsum(leaf_sizes)]).astype(np.int64)
    blind = _blind_data(buffer) if channel is None else buffer[:0]
    out = aligned_buffer(int(starts[-1]) + len(blind), zeroed=True)
    _write_heads(out, buffer, grid_type, (leaf_begin, lower_begin, upper_begin, HEAD_SIZE), int(starts[-1]), blind)
    old_upper = _Nodes(buffer, begins[2], counts[2], old.upper_size, UPPER_SLOTS, old.upper_table, old)
    old_lower = _Nodes(buffer, begins[1], counts[1], old.lower_size, LOWER_SLOTS, old.lower_table, old)
    new_upper = _Nodes(out, upper_begin, counts[2], new.upper_size, UPPER_SLOTS, new.upper_table, new)
    new_lower = _Nodes(out, lower_begin, counts[1], new.lower_size, LOWER_SLOTS, new.lower_table, new)
    _copy_root(out, buffer, begins[3], old, new, channel)
    _relink_root(out, buffer, begins, tiles, old, new, upper_begin, channel)
    lower_starts = begins[1] + old.lower_size * np.arange(counts[1])
    new_lower_starts = lower_begin + new.lower_size * np.arange(counts[1])
    upper_of_lower = _copy_nodes(new_upper, old_upper, lower_starts, new_lower_starts, channel)
    lower_of_leaf = _copy_nodes(new_lower, old_lower, leaf_starts(buffer), starts[:-1], channel)
    return RetypedTree(out, starts[:-1], lower_of_leaf, upper_of_lower)


def _layout_of(buffer: NDArray[np.uint8]) -> GridLayout:
    """Layout of a grid of values or of indices."""
    number = int(grid_header(buffer)["grid_type"])
    return INDEX_LAYOUTS.get(type_name(number)) or layout_of(number, "grid")


def _blind_data(buffer: NDArray[np.uint8]) -> NDArray[np.uint8]:
    # Offsets count from the entries, so that entries and data can move together.
    grid = grid_header(buffer)
    return buffer[int(grid["blind_offset"]) :] if int(grid["blind_count"]) else buffer[:0]


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


def _copy_root(
    out: NDArray[np.uint8],
    buffer: NDArray[np.uint8],
    root: int,
    old: GridLayout,
    new: GridLayout,
    channel: NDArray[Any] | None,
) -> None:
    out[HEAD_SIZE : HEAD_SIZE + 28] = buffer[root : root + 28]
    source = _Nodes(buffer, root, 1, old.root_size, 0, 0, old)
    target = _Nodes(out, HEAD_SIZE, 1, new.root_size, 0, 0, new)
    size = (old.background.itemsize, new.background.itemsize)
    background = source.column(old.background, old.root_background, 1, size[0])
    stored = target.column(new.background, new.root_background, 1, size[1])
    if channel is not None:
        stored[:] = channel[background]
        return
    with np.errstate(over="ignore"):
        stored[:] = background
        _copy_statistics(
            _statistics(target, new.root_background + size[1], new),
            _statistics(source, old.root_background + size[0], old),
        )


def _relink_root(
    out: NDArray[np.uint8],
    buffer: NDArray[np.uint8],
    begins: list[int],
    tiles: int,
    old: GridLayout,
    new: GridLayout,
    upper_begin: int,
    channel: NDArray[Any] | None,
) -> None:
    source = buffer[begins[3] + old.root_size :][: tiles * old.root_tile_size].view(root_tile_type(old))
    target = out[HEAD_SIZE + new.root_size :][: tiles * new.root_tile_size].view(root_tile_type(new))
    target["key"], target["state"] = source["key"], source["state"]
    has_child = source["child"] != 0
    if channel is None:
        target["value"] = source["value"]
    else:
        target["value"][~has_child] = channel[source["value"][~has_child]]
    node = (source["child"] + begins[3] - begins[2]) // old.upper_size
    target["child"] = np.where(has_child, upper_begin + node * new.upper_size - HEAD_SIZE, 0)


def _copy_statistics(target: tuple[NDArray[Any], ...], source: tuple[NDArray[Any], ...]) -> None:
    for to, of in zip(target, source, strict=True):
        to[:] = of


def _copy_nodes(
    target: _Nodes,
    source: _Nodes,
    old_starts: NDArray[np.int64],
    new_starts: NDArray[np.int64],
    channel: NDArray[Any] | None,
) -> NDArray[np.int64]:
    """Copy boxes, masks, statistics and slots of a level; returns the node of each child."""
    parent = np.empty(len(old_starts), np.int64)
    head = 32 + 2 * source.slots // 8
    if channel is None:
        _copy_statistics(target.statistics(), source.statistics())
    values = source.tiles(), target.tiles()
    offsets = [n.column("<i8", n.table, n.slots, n.layout.table_stride) for n in (source, target)]
    for first in range(0, source.count, NODES_AT_A_TIME):
        stop = min(first + NODES_AT_A_TIME, source.count)
        target.bytes()[first:stop, :head] = source.bytes()[first:stop, :head]
        node, slot = source.children(first, stop)
        if channel is None:
            with np.errstate(over="ignore", invalid="ignore"):  # a slot with a child holds no value
                values[1][first:stop] = values[0][first:stop]
        else:
            is_tile = np.ones((stop - first, source.slots), np.bool_)
            is_tile[node - first, slot] = False
            values[1][first:stop][is_tile] = channel[values[0][first:stop][is_tile]]
        at = source.begin + node * source.size + offsets[0][node, slot]
        child = np.searchsorted(old_starts, at)
        parent[child] = node
        offsets[1][node, slot] = new_starts[child] - (target.begin + node * target.size)
    return parent
