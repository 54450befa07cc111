"""Structural checks of a NanoVDB grid, so that a damaged buffer cannot make a kernel read outside it.

A checked grid has every node inside the buffer, levels that do not overlap, and child offsets that each lead to the
start of a node of the next level that no other slot refers to. In an index grid every index is below the number of its
values.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.header import BLIND_DATA, HEAD_SIZE, Damage, damage_named, grid_header, require_supported
from geokit.volume.nanovdb.index_checks import check_indices, index_layout
from geokit.volume.nanovdb.layout import ALIGNMENT, INDEX_LAYOUTS, LEAF_VOXELS, GridLayout
from geokit.volume.nanovdb.nodes import GridNodes, NodeLevel, bits_of, grid_nodes, root_origins, set_bits, slot_places

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

_CHECKED = "checked"

# The widest FpN code is 16 bits; a leaf stores the logarithm of its width.
FPN_LARGEST_LOG = 4
# Nodes checked at a time: the first damage ends the check, however many bits the other masks have.
NODES_AT_A_TIME = 256


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
    with damage_named(where):
        if int(grid_header(head)["grid_size"]) != size:
            raise Damage(f"its header says {int(grid_header(head)['grid_size'])} bytes and its file {size}")
        _check_levels(grid_nodes(head, layout), size)
    return layout


def check_grid(buffer: NDArray[np.uint8], where: str) -> GridLayout:
    """Check every offset of a grid.

    Args:
        buffer: The whole grid, uint8, aligned.
        where: File or argument, for the message.

    Returns:
        The layout of the grid's type.

    Raises:
        FileFormatError: A node, a child or the blind data lies outside its range, or a node says another place than
            that of its slot, or a bool is neither 0 nor 1.
        UnsupportedGridError: The grid's version, type or node order is not supported.
    """
    layout = check_head(buffer, len(buffer), where)
    with damage_named(where):
        grid = grid_nodes(buffer, layout)
        _check_levels(grid, len(buffer))
        end, origins, empty_upper = _check_root(grid)
        for level in (grid.upper, grid.lower, grid.leaf):
            if level.count and level.begin < end:
                raise Damage(f"the {level.name} nodes overlap what comes before them")
            end = max(end, level.end) if level.count else end
        origins, empty_lower = _check_children(grid.upper, grid.lower, origins)
        _check_children(grid.lower, grid.leaf, origins, layout.leaf_bits < 0)
        _check_empty(grid, empty_upper, empty_lower)
        if layout.background.base.kind == "b":
            _check_bools(grid)
        _check_blind_data(buffer, end)
        if layout.name in INDEX_LAYOUTS:
            check_indices(grid)
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


def _check_levels(grid: GridNodes, size: int) -> None:
    if size % ALIGNMENT:
        raise Damage(f"{size} bytes are no multiple of {ALIGNMENT}")
    for level in (grid.leaf, grid.lower, grid.upper, grid.root):
        if level.count and (level.begin < HEAD_SIZE or level.begin % ALIGNMENT or level.end > size):
            raise Damage(f"{level.count} {level.name} nodes do not fit where its header puts them")


def _check_root(grid: GridNodes) -> tuple[int, NDArray[np.int32], NDArray[np.bool_]]:
    """End of the root's table, and of the upper nodes, by address: origins, and which of them have an empty box."""
    root, upper, count = grid.root, grid.upper, int(grid.entry_count[0])
    end = root.end + count * root.layout.root_tile_size
    if end > len(root.buffer):
        raise Damage(f"{count} tiles of the root do not fit")
    keys, child = grid.table["key"], grid.table["child"]
    if len(np.unique(keys)) != count:
        raise Damage("two tiles of the root stand for the same place")
    if (keys >> np.uint64(63)).any():
        raise Damage("a tile of the root stands for no place")
    keys, child = keys[child != 0], child[child != 0]
    _check_targets(child.astype(np.float64) + root.begin, child + np.int64(root.begin), upper)
    if len(np.unique(child)) != upper.count or len(child) != upper.count:
        raise Damage(f"the root leads to {len(child)} of {upper.count} upper nodes")
    order = np.argsort(child)
    origins = root_origins(keys[order])
    return end, origins, _check_origins(upper, root.begin + child[order], origins)


def _check_targets(rough: NDArray[np.float64], target: NDArray[np.int64], level: NodeLevel) -> None:
    # The float sum reveals an overflow that wrapping would hide in the integer sum.
    inside = (rough >= level.begin) & (rough < level.end) & (target >= level.begin) & (target < level.end)
    if not inside.all() or ((target - level.begin) % level.size).any():
        raise Damage(f"an offset does not lead to a {level.name} node")


def _check_children(
    nodes: NodeLevel, below: NodeLevel, origins: NDArray[np.int32], variable: bool = False
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Check the children of nodes with the given origins; returns their origins, and which have an empty box."""
    parts, places = [np.empty(0, np.int64)], [np.empty((0, 3), np.int32)]
    for first, part in nodes.parts(NODES_AT_A_TIME):
        node, slot = set_bits(part.child_mask)
        base = part.begin + node * part.size
        child = part.child_offsets[node, slot]
        if not variable:
            _check_targets(base.astype(np.float64) + child, base + child, below)
        elif len(child) and (np.abs(child.astype(np.float64)) > len(nodes.buffer)).any():
            raise Damage(f"an offset does not lead to a {below.name} node")
        parts.append(base + child)
        places.append(origins[first + node] + nodes.span * slot_places(slot, nodes.width))
    target, origins = np.concatenate(parts), np.concatenate(places)
    if (target[1:] < target[:-1]).any():
        order = np.argsort(target)
        target, origins = target[order], origins[order]
    if len(target) != below.count or (target[1:] == target[:-1]).any():
        raise Damage(f"the {nodes.name} nodes lead to {len(target)} of {below.count} {below.name} nodes")
    if variable and len(target):
        _check_variable_leaves(target, below)
    return origins, _check_origins(below, target, origins)


def _check_origins(level: NodeLevel, starts: NDArray[np.int64], origins: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Check that nodes say the places that their slots have: kernels find nodes by slots, OpenVDB by what they say.

    Returns:
        The nodes whose box says no place because it is empty, (N,).
    """
    words = level.buffer.view("<i4")
    box = words[(starts // 4)[:, None] + np.arange(3 if level.name == "leaf" else 6)]
    empty = np.zeros(len(box), np.bool_) if level.name == "leaf" else (box[:, :3] > box[:, 3:]).all(axis=1)
    stated = box[:, :3] & ~np.int32(level.width * level.span - 1)
    wrong = (stated != origins).any(axis=1) & ~empty
    if wrong.any():
        row = int(np.argmax(wrong))
        said, place = stated[row].tolist(), origins[row].tolist()
        raise Damage(f"{level.name} node {row} says that it begins at {said}, and its slot begins at {place}")
    return np.asarray(empty)


def _check_empty(grid: GridNodes, upper: NDArray[np.bool_], lower: NDArray[np.bool_]) -> None:
    """Check that nodes with an empty box have no active voxel below them: OpenVDB writes such boxes for them."""
    if not (upper.any() or lower.any()):
        return
    starts = grid.leaf.starts
    masks = grid.root.buffer[starts[:, None] + np.arange(16, 16 + LEAF_VOXELS // 8)]
    active: NDArray[np.bool_] = masks.any(axis=1)
    for level, empty in ((grid.lower, lower), (grid.upper, upper)):
        node, _, start = level.links()
        below = active[np.searchsorted(starts, start)]
        active = np.asarray(level.tile_mask.any(axis=1))
        active[node[below]] = True
        if (active & empty).any():
            row = int(np.argmax(active & empty))
            raise Damage(f"{level.name} node {row} has active voxels, and says that it has none")
        starts = level.starts


def _check_bools(grid: GridNodes) -> None:
    """Check that tiles of bools are 0 or 1: C++ code may do anything with another byte."""
    found = [grid.background[None], grid.table["value"][grid.table["child"] == 0]]
    for level in (grid.upper, grid.lower):
        found += [part.values[~bits_of(part.child_mask)] for _, part in level.parts()]
    if any((values.view(np.uint8) > 1).any() for values in found):
        raise Damage("a tile or the background is neither true nor false")


def _check_variable_leaves(start: NDArray[np.int64], leaf: NodeLevel) -> None:
    # Each leaf stores its own width in bits; it must end before the next one starts.
    buffer = leaf.buffer
    if start[0] != leaf.begin or start[-1] + leaf.size > len(buffer) or (start % ALIGNMENT).any():
        raise Damage("an offset does not lead to a leaf node")
    width = buffer[start + 15] >> 5
    end = start + (leaf.size - LEAF_VOXELS // 8) + (LEAF_VOXELS // 8 << width.astype(np.int64))
    if (width > FPN_LARGEST_LOG).any() or (end[:-1] != start[1:]).any() or end[-1] > len(buffer):
        raise Damage("the leaves of variable width do not follow each other")


def _check_blind_data(buffer: NDArray[np.uint8], tree_end: int) -> None:
    grid = grid_header(buffer)
    count, offset = int(grid["blind_count"]), int(grid["blind_offset"])
    # Without blind data the offset is zero up to version 32.4, later the end of the grid.
    if not count and offset == 0:
        return
    if offset < tree_end or offset % 8 or offset + count * BLIND_DATA.itemsize > len(buffer):
        raise Damage(f"{count} blocks of blind data do not fit")
    entries = buffer[offset : offset + count * BLIND_DATA.itemsize].view(BLIND_DATA)
    # Offsets count from the entry. The size of a value is zero if the writer (before 32.6) did not state it.
    start = entries["offset"].astype(np.float64) + offset + BLIND_DATA.itemsize * np.arange(count)
    end = start + entries["value_count"].astype(np.float64) * entries["value_size"]
    if (start < HEAD_SIZE).any() or (end > len(buffer)).any() or (start > len(buffer)).any():
        raise Damage("a block of blind data lies outside")
