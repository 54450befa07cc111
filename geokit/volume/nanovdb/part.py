"""The part of a grid in a box, from a grid that may be larger than memory: the nodes that meet the box, and no others.

Only these are read. Their offsets are checked before they are followed, and ``check_grid`` can judge the result as any
other grid.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.header import HEAD_SIZE, TREE_OFFSET, Damage, aligned_buffer, grid_header, tree_header
from geokit.volume.nanovdb.layout import GridLayout
from geokit.volume.nanovdb.nodes import GridNodes, NodeLevel, grid_nodes, root_origins, set_bits, slot_places


class Part:
    """The nodes of a grid that meet a box.

    Args:
        grid: The grid, as a file that is mapped into memory; its headers are checked.
        layout: Layout of its type, whose leaves all have one size.
        low: First voxel of the box, (3,).
        high: Last voxel.
    Raises:
        Damage: An offset leads nowhere.
    """

    def __init__(
        self, grid: NDArray[np.uint8], layout: GridLayout, low: NDArray[np.int64], high: NDArray[np.int64]
    ) -> None:
        self._grid, self._layout = grid, layout
        self._low, self._high = low, high
        nodes = self._nodes = grid_nodes(grid, layout)
        if nodes.root.end + int(nodes.entry_count[0]) * layout.root_tile_size > len(grid):
            raise Damage("the table of the root does not fit")
        table = nodes.table
        # Tiles of the root are few, and all are kept.
        self._entries = np.flatnonzero((table["child"] == 0) | self._meets(root_origins(table["key"]), 4096))
        child = self._entries[table["child"][self._entries] != 0]
        self._uppers = self._rows(nodes.upper, nodes.root.begin + table["child"][child])
        origins = root_origins(table["key"][child])
        self._upper_links, self._lowers, origins = self._below(nodes.upper, self._uppers, origins, nodes.lower)
        self._lower_links, self._leaves, _ = self._below(nodes.lower, self._lowers, origins, nodes.leaf)

    @property
    def size(self) -> int:
        """Bytes of the grid of these nodes."""
        return self._begins()[-1]

    def buffer(self) -> NDArray[np.uint8]:
        """A grid of these nodes; where others were are inactive tiles of the background."""
        nodes, layout = self._nodes, self._layout
        root, upper, lower, leaf, end = self._begins()
        buffer = aligned_buffer(end, zeroed=True)
        buffer[:HEAD_SIZE] = self._grid[:HEAD_SIZE]
        head, tree = grid_header(buffer), tree_header(buffer)
        head["grid_size"], head["blind_count"], head["blind_offset"], head["checksum"] = end, 0, end, 0
        head["grid_index"], head["grid_count"] = 0, 1
        tree["node_count"] = [len(self._leaves), len(self._lowers), len(self._uppers)]
        tree["node_offset"] = [at - TREE_OFFSET for at in (leaf, lower, upper, root)]
        buffer[root : root + layout.root_size] = self._grid[nodes.root.begin : nodes.root.end]
        made = grid_nodes(buffer, layout)
        made.entry_count[0] = len(self._entries)
        table = made.table
        table[:] = nodes.table[self._entries]
        table["child"][table["child"] != 0] = upper - root + layout.upper_size * np.arange(len(self._uppers))
        for level, source, rows in (
            (made.upper, nodes.upper, self._uppers),
            (made.lower, nodes.lower, self._lowers),
            (made.leaf, nodes.leaf, self._leaves),
        ):
            made_bytes = level.column(np.uint8, 0, level.size)
            np.take(source.column(np.uint8, 0, level.size), rows, axis=0, out=made_bytes, mode="clip")
        self._link(made, made.upper, self._upper_links, lower, layout.lower_size)
        self._link(made, made.lower, self._lower_links, leaf, layout.leaf_size)
        return buffer

    def _begins(self) -> tuple[int, int, int, int, int]:
        """Where root, upper nodes, lower nodes and leaves begin, and where these end."""
        layout = self._layout
        root = HEAD_SIZE
        upper = root + layout.root_size + len(self._entries) * layout.root_tile_size
        lower = upper + len(self._uppers) * layout.upper_size
        leaf = lower + len(self._lowers) * layout.lower_size
        return root, upper, lower, leaf, leaf + len(self._leaves) * layout.leaf_size

    def _meets(self, origins: NDArray[np.int32], span: int) -> NDArray[np.bool_]:
        first = origins.astype(np.int64)
        return np.asarray(((first <= self._high) & (first + (span - 1) >= self._low)).all(axis=1))

    def _below(
        self, level: NodeLevel, rows: NDArray[np.int64], origins: NDArray[np.int32], below: NodeLevel
    ) -> tuple[tuple[NDArray[np.int64], NDArray[np.int64]], NDArray[np.int64], NDArray[np.int32]]:
        """Of nodes in some rows: place among these and slot of each child that meets the box; its row, and origin."""
        node, slot = set_bits(level.child_mask[rows])
        first = origins[node] + level.span * slot_places(slot, level.width)
        kept = self._meets(first, level.span)
        node, slot, first = node[kept], slot[kept], first[kept]
        starts = level.begin + rows[node] * level.size + level.child_offsets[rows[node], slot]
        return (node, slot), self._rows(below, starts), first

    def _rows(self, level: NodeLevel, starts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Rows of the nodes that begin at some offsets."""
        row, rest = np.divmod(starts - level.begin, level.size)
        if (rest != 0).any() or (row < 0).any() or (row >= level.count).any():
            raise Damage(f"an offset does not lead to a {level.name} node")
        # A node with many parents could make a result much larger than its file.
        if len(np.unique(row)) < len(row):
            raise Damage(f"two offsets lead to one {level.name} node")
        return np.asarray(row)

    def _link(
        self,
        made: GridNodes,
        level: NodeLevel,
        links: tuple[NDArray[np.int64], NDArray[np.int64]],
        begin: int,
        size: int,
    ) -> None:
        """Point slots to the children that were kept, in their order; the other children become background."""
        node, slot = links
        before_node, before_slot = set_bits(level.child_mask)
        level.values[before_node, before_slot] = made.background
        level.value_mask[:] &= ~level.child_mask
        level.child_mask[:] = 0
        starts = level.begin + node * level.size
        level.child_offsets[node, slot] = begin + size * np.arange(len(node)) - starts
        np.bitwise_or.at(level.child_mask, (node, slot >> 3), (1 << (slot & 7)).astype(np.uint8))
