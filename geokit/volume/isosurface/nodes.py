"""Lists the lower nodes, leaves and active tiles of a NanoVDB buffer, with their offsets and origins."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume._model import SparseVolume
from geokit.volume.nanovdb.header import TREE_OFFSET, grid_header, tree_header
from geokit.volume.nanovdb.layout import LOWER_SLOTS, UPPER_SLOTS, GridLayout, layout_of
from geokit.volume.nanovdb.types import FLOAT
from geokit.volume.nanovdb.upload import above_leaves

if TYPE_CHECKING:
    import warp as wp

__all__ = ["Nodes", "Topology", "place_of", "topology_of"]


class Nodes(NamedTuple):
    origin: NDArray[np.int32]  # (N, 3)
    offset: NDArray[np.int64]  # (N,) bytes from the grid's start
    parent: NDArray[np.int64]  # (N,) numbers of the parent nodes
    slot: NDArray[np.int64]  # (N,) slots in the parents


@dataclass(eq=False)
class Topology:
    """Nodes of a grid, independent of the isovalue; cached per volume, because they take as long as finding the cells.

    Attributes:
        is_float: Whether the grid's values are float32.
        layout: Layout of nodes of the grid's type.
        begins: Byte offsets of leaves, lower nodes, upper nodes and root from the grid's start.
        lower: Lower nodes in the order of their addresses.
        leaves: Leaves in the order of their addresses.
        active_node: Lower nodes of the active tiles of 8^3 voxels, shape (A,) int32.
        active_slot: Slots of these tiles in them, shape (A,) int32.
        large_borders: First voxels of the blocks of 8^3 voxels at the borders of larger active tiles, shape (N, 3).
        arrays: By device: offsets and origins of the leaves, their lower nodes and slots, origins of the lower nodes.
    """

    is_float: bool
    layout: GridLayout
    begins: tuple[int, ...]
    lower: Nodes
    leaves: Nodes
    active_node: NDArray[np.int32]
    active_slot: NDArray[np.int32]
    large_borders: NDArray[np.int32]
    arrays: dict[str, tuple["wp.array", ...]] = field(default_factory=dict)

    @property
    def has_tiles(self) -> bool:
        """Whether the surface may run through active tiles."""
        return bool(len(self.active_node) or len(self.large_borders))

    def on(self, device: "wp.Device") -> tuple["wp.array", ...]:
        """The arrays on a device."""
        import warp as wp

        if device.alias not in self.arrays:
            leaves = self.leaves
            self.arrays[device.alias] = (
                wp.array(leaves.offset.astype(np.uint64), dtype=wp.uint64, device=device),
                wp.array(leaves.origin, dtype=wp.vec3i, device=device),
                wp.array(leaves.parent.astype(np.int32), dtype=wp.int32, device=device),
                wp.array(leaves.slot.astype(np.int32), dtype=wp.int32, device=device),
                wp.array(self.lower.origin, dtype=wp.vec3i, device=device),
            )
        return self.arrays[device.alias]


def topology_of(volume: SparseVolume) -> Topology:
    """The nodes of a volume's tree, cached per volume."""
    return volume._cache.find("topology", lambda: _find_topology(above_leaves(volume)))


def _find_topology(buffer: NDArray[np.uint8]) -> Topology:
    grid_type = int(grid_header(buffer)["grid_type"])
    layout = layout_of(grid_type, "volume")
    begins = tuple(TREE_OFFSET + int(offset) for offset in tree_header(buffer)["node_offset"])
    upper, table = _upper_nodes(buffer, begins[3], layout)
    lower = _children(buffer, upper, UPPER_SLOTS, layout.upper_table, layout.upper_size, 5, 128)
    leaves = _children(buffer, lower, LOWER_SLOTS, layout.lower_table, layout.lower_size, 4, 8)
    active, children = _masks(buffer, lower, LOWER_SLOTS, layout.lower_size)
    node, slot = (part.astype(np.int32) for part in _bits(active & ~children))
    borders = _large_borders(buffer, upper, table, layout)
    return Topology(grid_type == FLOAT, layout, begins, lower, leaves, node, slot, borders)


def _large_borders(
    buffer: NDArray[np.uint8], upper: Nodes, table: NDArray[np.uint8], layout: GridLayout
) -> NDArray[np.int32]:
    active, children = _masks(buffer, upper, UPPER_SLOTS, layout.upper_size)
    node, slot = _bits(active & ~children)
    state = table[:, 16:20].copy().view("<u4")[:, 0]
    root = _root_places(table)[(state != 0) & (_root_children(table) == 0)]
    found = [np.empty((0, 3), np.int32)]
    for corners, size in ((upper.origin[node] + 128 * place_of(slot, 5), 16), (root, 512)):
        if len(corners):
            found.append((corners[:, None] + 8 * _border(size)).reshape(-1, 3))
    return np.concatenate(found)


def _border(size: int) -> NDArray[np.int32]:
    """Places (N, 3) on the faces of a cube with ``size`` blocks along each edge."""
    a, b = (part.ravel() for part in np.meshgrid(*2 * [np.arange(size, dtype=np.int32)], indexing="ij"))
    ends = [np.full(len(a), end, np.int32) for end in (0, size - 1)]
    faces = [np.stack(order, axis=1) for end in ends for order in ((end, a, b), (a, end, b), (a, b, end))]
    return np.unique(np.concatenate(faces), axis=0)


def _upper_nodes(buffer: NDArray[np.uint8], root: int, layout: GridLayout) -> tuple[Nodes, NDArray[np.uint8]]:
    """Upper nodes in the order of their addresses, and the root's table, a row for each entry."""
    count = int(buffer[root + 24 : root + 28].view("<u4")[0])
    begin = root + layout.root_size
    table = buffer[begin : begin + count * layout.root_tile_size].reshape(count, layout.root_tile_size)
    child = _root_children(table)
    has_child = child != 0
    none = np.zeros(int(has_child.sum()), np.int64)
    return _in_order(_root_places(table)[has_child], root + child[has_child], none, none), table


def _root_children(table: NDArray[np.uint8]) -> NDArray[np.int64]:
    return np.asarray(table[:, 8:16].copy().view("<i8")[:, 0])


def _root_places(table: NDArray[np.uint8]) -> NDArray[np.int32]:
    """First voxels (N, 3) of the root's entries. A key holds the upper 20 bits of each coordinate, x highest."""
    keys = table[:, :8].copy().view("<u8")[:, 0]
    places = np.stack([keys >> np.uint64(42), keys >> np.uint64(21), keys], axis=1) & np.uint64(0xFFFFF)
    return (places << np.uint64(12)).astype(np.uint32).view(np.int32)


def _children(
    buffer: NDArray[np.uint8], nodes: Nodes, slots: int, table: int, size: int, bits: int, span: int
) -> Nodes:
    count = len(nodes.offset)
    if not count:
        return Nodes(np.empty((0, 3), np.int32), *(np.empty(0, np.int64) for _ in range(3)))
    begin = int(nodes.offset[0])
    offsets = np.ndarray((count, slots), "<i8", buffer, begin + table, (size, 8))
    node, slot = _bits(_masks(buffer, nodes, slots, size)[1])
    return _in_order(
        nodes.origin[node] + span * place_of(slot, bits), nodes.offset[node] + offsets[node, slot], node, slot
    )


def _masks(buffer: NDArray[np.uint8], nodes: Nodes, slots: int, size: int) -> list[NDArray[np.uint8]]:
    """Bit masks of the active slots and of the children of contiguous nodes, shape (N, slots / 8) each."""
    count = len(nodes.offset)
    if not count:
        return [np.empty((0, slots // 8), np.uint8)] * 2
    begin = int(nodes.offset[0]) + 32
    return [np.ndarray((count, slots // 8), np.uint8, buffer, begin + skip, (size, 1)) for skip in (0, slots // 8)]


def _bits(masks: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and numbers of the set bits, row by row."""
    # Most bytes of the masks are zero; only the others are unpacked.
    row, byte = np.nonzero(masks)
    part, bit = np.nonzero(np.unpackbits(masks[row, byte][:, None], axis=1, bitorder="little"))
    return row[part], 8 * byte[part] + bit


def place_of(slot: NDArray[Any], bits: int) -> NDArray[np.int32]:
    """Coordinates (N, 3) of slots within their node."""
    low = (1 << bits) - 1
    return np.stack([slot >> 2 * bits, slot >> bits & low, slot & low], axis=1).astype(np.int32)


def _in_order(
    origin: NDArray[np.int32], offset: NDArray[np.int64], parent: NDArray[np.int64], slot: NDArray[np.int64]
) -> Nodes:
    if (offset[1:] > offset[:-1]).all():
        return Nodes(origin, offset, parent, slot)
    order = np.argsort(offset)
    return Nodes(origin[order], offset[order], parent[order], slot[order])
