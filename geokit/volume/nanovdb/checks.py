"""Structural checks of a NanoVDB grid, so that a damaged buffer cannot make a kernel read outside it.

A checked grid has every node inside the buffer, levels that do not overlap, and child offsets that each lead to the
start of a node of the next level that no other slot refers to. In an index grid every index is below the number of its
values.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError
from geokit.volume.nanovdb.header import (
    BLIND_DATA,
    HEAD_SIZE,
    TREE_OFFSET,
    grid_header,
    require_supported,
    tree_header,
)
from geokit.volume.nanovdb.index_checks import index_damage, index_layout
from geokit.volume.nanovdb.layout import (
    ALIGNMENT,
    INDEX_LAYOUTS,
    LEAF_VOXELS,
    LOWER_SLOTS,
    UPPER_SLOTS,
    GridLayout,
)

if TYPE_CHECKING:
    from geokit.volume._model import SparseVolume

__all__ = ["check_grid", "check_head", "check_volume", "mark_checked"]

_CHECKED = "checked"

# The widest FpN code is 16 bits; a leaf stores the logarithm of its width.
FPN_LARGEST_LOG = 4
# Nodes whose masks are unpacked at a time: the bits of 256 lower nodes are a megabyte.
NODES_AT_A_TIME = 256


@dataclass(frozen=True)
class _Level:
    name: str
    begin: int
    count: int
    size: int

    @property
    def end(self) -> int:
        return self.begin + self.count * self.size


class _Damage(Exception):
    pass


def check_head(head: NDArray[np.uint8], size: int, where: str) -> GridLayout:
    """Check a grid's headers against its size before memory of that size is allocated.

    Args:
        head: At least the first 736 bytes of the grid.
        size: Declared size of the grid in bytes.
        where: File or argument, for the message.

    Returns:
        The layout of the grid's type.

    Raises:
        FileFormatError: The headers contradict each other or the size.
        UnsupportedGridError: The grid's version, type or node order is not supported.
    """
    layout = index_layout(head, where) or require_supported(head, where)
    try:
        if int(grid_header(head)["grid_size"]) != size:
            raise _Damage(f"its header says {int(grid_header(head)['grid_size'])} bytes and its file {size}")
        _levels(head, layout, size)
    except _Damage as damage:
        raise _refusal(where, damage) from None
    return layout


def check_grid(buffer: NDArray[np.uint8], where: str) -> GridLayout:
    """Check every offset of a grid.

    Args:
        buffer: The whole grid, uint8, aligned.
        where: File or argument, for the message.

    Returns:
        The layout of the grid's type.

    Raises:
        FileFormatError: A node, a child or the blind data lies outside its range.
        UnsupportedGridError: The grid's version, type or node order is not supported.
    """
    layout = check_head(buffer, len(buffer), where)
    try:
        root, upper, lower, leaf = _levels(buffer, layout, len(buffer))
        end = _check_root(buffer, layout, root, upper)
        for level in (upper, lower, leaf):
            if level.count and level.begin < end:
                raise _Damage(f"the {level.name} nodes overlap what comes before them")
            end = max(end, level.end) if level.count else end
        _check_children(buffer, upper, lower, layout.upper_table, UPPER_SLOTS, layout.table_stride)
        _check_children(buffer, lower, leaf, layout.lower_table, LOWER_SLOTS, layout.table_stride, layout.leaf_bits < 0)
        _check_blind_data(buffer, end)
        _check_indices(buffer, layout, root, upper, lower, leaf)
    except _Damage as damage:
        raise _refusal(where, damage) from None
    return layout


def check_volume(volume: SparseVolume, where: str = "") -> None:
    """Check every offset of a volume's grid, once for each volume.

    Args:
        volume: The grid.
        where: For the message; the volume's name where it is empty.

    Raises:
        FileFormatError, UnsupportedGridError: As :func:`check_grid`.
    """
    if _CHECKED not in volume._cache:
        check_grid(volume.nanovdb, where or f"volume {volume.info.name!r}")
        mark_checked(volume)


def mark_checked(volume: SparseVolume) -> None:
    """Record that :func:`check_grid` has accepted a volume's grid, or that it was built in place on a device."""
    volume._cache.keep(_CHECKED, True)


def _check_indices(buffer: NDArray[np.uint8], layout: GridLayout, root: _Level, *levels: _Level) -> None:
    if layout.name in INDEX_LAYOUTS:
        damage = index_damage(buffer, layout, root.begin, *((level.begin, level.count) for level in levels))
        if damage:
            raise _Damage(damage)


def _refusal(where: str, damage: _Damage) -> FileFormatError:
    return FileFormatError(f"{where}: the grid is damaged, {damage}; get the file again from its source")


def _levels(head: NDArray[np.uint8], layout: GridLayout, size: int) -> tuple[_Level, _Level, _Level, _Level]:
    tree = tree_header(head)
    sizes = (layout.leaf_size, layout.lower_size, layout.upper_size, layout.root_size)
    counts = (*(int(n) for n in tree["node_count"]), 1)
    if size % ALIGNMENT:
        raise _Damage(f"{size} bytes are no multiple of {ALIGNMENT}")
    found = []
    for name, offset, count, node in zip(
        ("leaf", "lower", "upper", "root"), tree["node_offset"], counts, sizes, strict=True
    ):
        begin = TREE_OFFSET + int(offset)
        level = _Level(name, begin, count, node)
        if count and (begin < HEAD_SIZE or begin % ALIGNMENT or level.end > size):
            raise _Damage(f"{count} {name} nodes do not fit where its header puts them")
        found.append(level)
    return found[3], found[2], found[1], found[0]


def _check_root(buffer: NDArray[np.uint8], layout: GridLayout, root: _Level, upper: _Level) -> int:
    count = int(buffer[root.begin + 24 : root.begin + 28].view("<u4")[0])
    end = root.end + count * layout.root_tile_size
    if end > len(buffer):
        raise _Damage(f"{count} tiles of the root do not fit")
    table = buffer[root.end : end].reshape(count, layout.root_tile_size)
    keys = table[:, :8].copy().view("<u8")[:, 0]
    if len(np.unique(keys)) != count:
        raise _Damage("two tiles of the root stand for the same place")
    child = table[:, 8:16].copy().view("<i8")[:, 0]
    child = child[child != 0]
    _check_targets(child.astype(np.float64) + root.begin, child + np.int64(root.begin), upper)
    if len(np.unique(child)) != upper.count or len(child) != upper.count:
        raise _Damage(f"the root leads to {len(child)} of {upper.count} upper nodes")
    return end


def _check_targets(rough: NDArray[np.float64], target: NDArray[np.int64], level: _Level) -> None:
    # The float sum reveals an overflow that wrapping would hide in the integer sum.
    inside = (rough >= level.begin) & (rough < level.end) & (target >= level.begin) & (target < level.end)
    if not inside.all() or ((target - level.begin) % level.size).any():
        raise _Damage(f"an offset does not lead to a {level.name} node")


def _check_children(
    buffer: NDArray[np.uint8], nodes: _Level, below: _Level, table: int, slots: int, stride: int, variable: bool = False
) -> None:
    parts = []
    for first in range(0, nodes.count, NODES_AT_A_TIME):
        count = min(NODES_AT_A_TIME, nodes.count - first)
        begin = nodes.begin + first * nodes.size
        mask = np.ndarray((count, slots // 8), np.uint8, buffer, begin + 32 + slots // 8, (nodes.size, 1))
        offsets = np.ndarray((count, slots), "<i8", buffer, begin + table, (nodes.size, stride))
        node, slot = np.nonzero(np.unpackbits(mask, axis=1, bitorder="little"))
        base = begin + node * nodes.size
        child = offsets[node, slot]
        if not variable:
            _check_targets(base.astype(np.float64) + child, base + child, below)
        elif len(child) and (np.abs(child.astype(np.float64)) > len(buffer)).any():
            raise _Damage(f"an offset does not lead to a {below.name} node")
        parts.append(base + child)
    target = np.sort(np.concatenate(parts)) if parts else np.empty(0, np.int64)
    if len(target) != below.count or (target[1:] == target[:-1]).any():
        raise _Damage(f"the {nodes.name} nodes lead to {len(target)} of {below.count} {below.name} nodes")
    if variable and len(target):
        _check_variable_leaves(buffer, target, below)


def _check_variable_leaves(buffer: NDArray[np.uint8], start: NDArray[np.int64], leaf: _Level) -> None:
    # Each leaf stores its own width in bits; it must end before the next one starts.
    if start[0] != leaf.begin or start[-1] + leaf.size > len(buffer) or (start % ALIGNMENT).any():
        raise _Damage("an offset does not lead to a leaf node")
    width = buffer[start + 15] >> 5
    end = start + (leaf.size - LEAF_VOXELS // 8) + (LEAF_VOXELS // 8 << width.astype(np.int64))
    if (width > FPN_LARGEST_LOG).any() or (end[:-1] != start[1:]).any() or end[-1] > len(buffer):
        raise _Damage("the leaves of variable width do not follow each other")


def _check_blind_data(buffer: NDArray[np.uint8], tree_end: int) -> None:
    grid = grid_header(buffer)
    count, offset = int(grid["blind_count"]), int(grid["blind_offset"])
    # Without blind data the offset is zero up to version 32.4, later the end of the grid.
    if not count and offset == 0:
        return
    if offset < tree_end or offset % 8 or offset + count * BLIND_DATA.itemsize > len(buffer):
        raise _Damage(f"{count} blocks of blind data do not fit")
    entries = buffer[offset : offset + count * BLIND_DATA.itemsize].view(BLIND_DATA)
    # Offsets count from the entry. The size of a value is zero if the writer (before 32.6) did not state it.
    start = entries["offset"].astype(np.float64) + offset + BLIND_DATA.itemsize * np.arange(count)
    end = start + entries["value_count"].astype(np.float64) * entries["value_size"]
    if (start < HEAD_SIZE).any() or (end > len(buffer)).any() or (start > len(buffer)).any():
        raise _Damage("a block of blind data lies outside")
