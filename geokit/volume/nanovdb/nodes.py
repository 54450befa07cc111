"""The nodes of a grid, level by level, as NumPy views on its buffer: reading copies nothing, writing goes to the grid.

Offsets are followed as they stand: ``check_grid`` comes first. In a checked grid the nodes of a level follow each other
in its buffer, in any order of their positions.

Source:
    NanoVDB (Museth 2021), NanoVDB.h 32.4 and 32.8.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.header import TREE_OFFSET, grid_header, tree_header
from geokit.volume.nanovdb.layout import INDEX_LAYOUTS, LEAF_VOXELS, GridLayout, layout_of, type_name

# Nodes processed together: the slots of 64 upper nodes are 16 MiB.
NODES_AT_A_TIME = 64


class NodePlaces(NamedTuple):
    """Where the nodes of a level are, in the order of their addresses.

    Attributes:
        origins: First voxel of each, (N, 3) int32.
        starts: Offset [bytes] of each from the grid's start, (N,).
        parents: Rows of their parents, (N,).
        slots: Their slots in the parents, (N,).
    """

    origins: NDArray[np.int32]
    starts: NDArray[np.int64]
    parents: NDArray[np.int64]
    slots: NDArray[np.int64]

    def in_order(self) -> NodePlaces:
        """Sort by address."""
        if (self.starts[1:] > self.starts[:-1]).all():
            return self
        order = np.argsort(self.starts)
        return NodePlaces(self.origins[order], self.starts[order], self.parents[order], self.slots[order])


@dataclass(frozen=True)
class NodeLevel:
    """The nodes of one level. Leaves of type fpn differ in size: of them only ``starts`` has a meaning.

    Attributes:
        buffer: The grid.
        layout: Layout of its type.
        name: "root", "upper", "lower" or "leaf".
        begin: Offset of the first node.
        count: Number of nodes N.
        size: Bytes of a node; for leaves that differ in size, of the smallest possible one.
        table: Offset of the slots from a node.
        width: Slots along an axis of a node.
        span: Voxels along an axis of a slot.
    """

    buffer: NDArray[np.uint8]
    layout: GridLayout
    name: str
    begin: int
    count: int
    size: int
    table: int
    width: int
    span: int

    @property
    def slots(self) -> int:
        """Number of slots of a node."""
        return self.width**3

    @property
    def end(self) -> int:
        """Offset of the end of the last node."""
        return self.begin + self.count * self.size

    @property
    def starts(self) -> NDArray[np.int64]:
        """Offset of each node, ascending, (N,)."""
        if self.name != "leaf" or self.layout.leaf_bits >= 0:
            return self.begin + self.size * np.arange(self.count)
        starts, at, memory = np.empty(self.count, np.int64), self.begin, self.buffer.data
        for i in range(self.count):
            starts[i] = at
            # Each leaf stores its own width.
            at += self.layout.leaf_header + (LEAF_VOXELS // 8 << (int(memory[at + 15]) >> 5))
        return starts

    def column(self, kind: Any, offset: int, count: int, step: int | None = None) -> NDArray[Any]:
        """View of ``count`` values of each node from ``offset`` on, ``step`` bytes apart, (N, count) or (N, count, C).

        Args:
            kind: NumPy type of a value; for vectors with their shape.
            offset: Offset of the first value from its node.
            count: Number of values.
            step: Bytes from one value to the next; None if they are adjacent.
        """
        kind = np.dtype(kind)
        shape = (self.count, count, *kind.shape)
        if not self.count:
            return np.empty(shape, kind.base)
        strides = (self.size, kind.itemsize if step is None else step, *[kind.base.itemsize] * len(kind.shape))
        return np.ndarray(shape, kind.base, self.buffer, self.begin + offset, strides)

    @property
    def origins(self) -> NDArray[np.int32]:
        """First voxel of each node as its box tells it, (N, 3), a copy."""
        # The box of the active voxels starts in the node, or at its first voxel if none is active.
        return np.asarray(self.column("<i4", 0, 3) & ~np.int32(self.width * self.span - 1))

    @property
    def value_mask(self) -> NDArray[np.uint8]:
        """Packed bits of the active slots or voxels, (N, slots / 8)."""
        return self.column(np.uint8, self._mask, self.slots // 8)

    @property
    def child_mask(self) -> NDArray[np.uint8]:
        """Packed bits of the slots that hold children, (N, slots / 8)."""
        return self.column(np.uint8, self._mask + self.slots // 8, self.slots // 8)

    @property
    def tile_mask(self) -> NDArray[np.uint8]:
        """Packed bits of the active tiles, (N, slots / 8), a copy."""
        return self.value_mask & ~self.child_mask

    @property
    def values(self) -> NDArray[Any]:
        """Values of tiles or unencoded voxels, (N, slots) or (N, slots, C); no value if a slot holds a child."""
        step = None if self.name == "leaf" else self.layout.table_stride
        return self.column(self.layout.background, self.table, self.slots, step)

    @property
    def bits(self) -> NDArray[np.uint8]:
        """Packed values of leaves of bools, (N, slots / 8)."""
        return self.column(np.uint8, self.table, self.slots // 8)

    @property
    def child_offsets(self) -> NDArray[np.int64]:
        """Offsets of the children from their nodes, (N, slots); no offset if a slot holds none."""
        return self.column("<i8", self.table, self.slots, self.layout.table_stride)

    @property
    def limits(self) -> NDArray[Any]:
        """Smallest and largest active value, (N, 2) or (N, 2, C)."""
        return self.column(self.layout.background, self._limits, 2)

    @property
    def moments(self) -> NDArray[Any]:
        """Average and deviation of the active values, (N, 2)."""
        stat = self.layout.stat
        begin = -(-(self._limits + 2 * self.layout.background.itemsize) // stat) * stat
        return self.column(f"<f{stat}", begin, 2)

    @property
    def _mask(self) -> int:
        return 16 if self.name == "leaf" else 32

    @property
    def _limits(self) -> int:
        if self.name == "root":
            return self.layout.root_background + self.layout.background.itemsize
        after = self._mask + self.slots // 8 * (1 if self.name == "leaf" else 2)
        return -(-after // self.layout.align) * self.layout.align

    def parts(self, step: int = NODES_AT_A_TIME) -> Iterator[tuple[int, NodeLevel]]:
        """The nodes in parts of ``step``, each with the row of its first node."""
        for first in range(0, self.count, step):
            yield first, replace(self, begin=self.begin + first * self.size, count=min(step, self.count - first))

    def links(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Node, slot and start of each child, node by node."""
        node, slot = set_bits(self.child_mask)
        return node, slot, self.begin + node * self.size + self.child_offsets[node, slot]

    def children(self, origins: NDArray[np.int32]) -> NodePlaces:
        """The nodes of the level below, from the origins (N, 3) of these."""
        node, slot, start = self.links()
        return NodePlaces(origins[node] + self.span * slot_places(slot, self.width), start, node, slot).in_order()


@dataclass(frozen=True)
class GridNodes:
    """The nodes of a grid: its root and the levels below."""

    root: NodeLevel
    upper: NodeLevel
    lower: NodeLevel
    leaf: NodeLevel

    @property
    def background(self) -> NDArray[Any]:
        """Value outside all nodes, () or (C,)."""
        layout = self.root.layout
        return self.root.column(layout.background, layout.root_background, 1)[0, 0, ...]

    @property
    def entry_count(self) -> NDArray[np.uint32]:
        """Number of entries of the root's table, (1,)."""
        return self.root.column("<u4", 24, 1)[0]

    @property
    def table(self) -> NDArray[Any]:
        """The root's table, (T,): ``key``, ``child`` (offset from the root, 0 for a tile), ``state`` and ``value``."""
        layout, end = self.root.layout, self.root.end
        kind = np.dtype(
            {
                "names": ["key", "child", "state", "value"],
                "formats": ["<u8", "<i8", "<u4", layout.background],
                "offsets": [0, 8, 16, -(-20 // layout.align) * layout.align],
                "itemsize": layout.root_tile_size,
            }
        )
        return self.root.buffer[end : end + int(self.entry_count[0]) * kind.itemsize].view(kind)

    def upper_places(self) -> NodePlaces:
        """Where the upper nodes are; their slots are rows of the root's table."""
        table = self.table
        slot = np.flatnonzero(table["child"])
        starts = self.root.begin + table["child"][slot]
        return NodePlaces(root_origins(table["key"][slot]), starts, np.zeros_like(slot), slot).in_order()


def grid_nodes(buffer: NDArray[np.uint8], layout: GridLayout | None = None) -> GridNodes:
    """The nodes of a grid, from its headers alone.

    Args:
        buffer: The grid; no more of it is needed than what is then read.
        layout: Layout of the grid's type; None to take it from the header.
    Raises:
        UnsupportedGridError: The header names a type that has no layout.
    """
    if layout is None:
        number = int(grid_header(buffer)["grid_type"])
        layout = INDEX_LAYOUTS.get(type_name(number)) or layout_of(number, "grid")
    tree = tree_header(buffer)
    counts = [*(int(count) for count in tree["node_count"]), 1]

    def level(i: int, name: str, size: int, table: int, width: int, span: int) -> NodeLevel:
        begin = TREE_OFFSET + int(tree["node_offset"][i])
        return NodeLevel(buffer, layout, name, begin, counts[i], size, table, width, span)

    return GridNodes(
        root=level(3, "root", layout.root_size, layout.root_size, 1, 4096),
        upper=level(2, "upper", layout.upper_size, layout.upper_table, 32, 128),
        lower=level(1, "lower", layout.lower_size, layout.lower_table, 16, 8),
        leaf=level(0, "leaf", layout.leaf_size, layout.leaf_table, 8, 1),
    )


def root_origins(keys: NDArray[np.uint64]) -> NDArray[np.int32]:
    """First voxels (N, 3) of the root entries with the given keys."""
    # A key has 20 bits of each coordinate, z lowest; the left shift puts their sign bit in place.
    parts = np.stack([keys >> np.uint64(42), keys >> np.uint64(21), keys], axis=1).astype(np.uint32)
    return np.asarray((parts << np.uint32(12)).view(np.int32))


def bits_of(masks: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Unpack masks (N, B) to bits (N, 8 B)."""
    return np.unpackbits(masks, axis=1, bitorder="little").view(np.bool_)


def set_bits(masks: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and numbers of the set bits of masks (N, B), row by row."""
    # Most bytes of the masks are zero; only the others are unpacked.
    row, byte = np.nonzero(masks)
    part, bit = np.nonzero(np.unpackbits(masks[row, byte][:, None], axis=1, bitorder="little"))
    return row[part], 8 * byte[part] + bit


def slot_places(slots: NDArray[Any], width: int) -> NDArray[np.int32]:
    """Coordinates (N, 3) of slots in nodes of ``width``^3 slots, a power of two."""
    bits = width.bit_length() - 1
    return np.stack([slots >> 2 * bits, slots >> bits & (width - 1), slots & (width - 1)], axis=1).astype(np.int32)


def slot_of(voxels: NDArray[Any], width: int, span: int) -> NDArray[np.int64]:
    """Slot index of voxels (N, 3) in nodes of ``width``^3 slots of ``span``^3 voxels each."""
    at = (voxels.astype(np.int64) // span) & (width - 1)
    return (at[:, 0] * width + at[:, 1]) * width + at[:, 2]
