"""Lists the lower nodes, leaves and active tiles of a NanoVDB buffer, with their offsets and origins."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geokit.volume.isosurface.large_tiles import LargeTileBorders, large_tile_borders
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.layout import GridLayout
from geokit.volume.nanovdb.nodes import NodePlaces, grid_nodes, set_bits
from geokit.volume.nanovdb.upload import above_leaves

if TYPE_CHECKING:
    import warp as wp

__all__ = ["Topology", "topology_of"]


@dataclass(eq=False)
class Topology:
    """Nodes of a grid, independent of the isovalue; cached per volume, because they take as long as finding the cells.

    Attributes:
        layout: Layout of nodes of the grid's type.
        begins: Byte offsets of leaves and lower nodes from the grid's start.
        lower: Lower nodes in the order of their addresses.
        leaves: Leaves in the order of their addresses.
        active_node: Lower nodes of the active tiles of 8^3 voxels, shape (A,) int32.
        active_slot: Slots of these tiles in them, shape (A,) int32.
        large: Borders of larger active tiles.
        arrays: By device: offsets and origins of the leaves, their lower nodes and slots, origins of the lower nodes.
    """

    layout: GridLayout
    begins: tuple[int, int]
    lower: NodePlaces
    leaves: NodePlaces
    active_node: NDArray[np.int32]
    active_slot: NDArray[np.int32]
    large: LargeTileBorders
    arrays: dict[str, tuple["wp.array", ...]] = field(default_factory=dict)

    @property
    def is_float(self) -> bool:
        """Whether the grid's values are float32, unencoded."""
        return self.layout.name == "float"

    @property
    def has_tiles(self) -> bool:
        """Whether the surface may run through active tiles."""
        return bool(len(self.active_node) or len(self.large.corners))

    def on(self, device: "wp.Device") -> tuple["wp.array", ...]:
        """The arrays on a device."""
        import warp as wp

        if device.alias not in self.arrays:
            leaves = self.leaves
            self.arrays[device.alias] = (
                wp.array(leaves.starts.astype(np.uint64), dtype=wp.uint64, device=device),
                wp.array(leaves.origins, dtype=wp.vec3i, device=device),
                wp.array(leaves.parents.astype(np.int32), dtype=wp.int32, device=device),
                wp.array(leaves.slots.astype(np.int32), dtype=wp.int32, device=device),
                wp.array(self.lower.origins, dtype=wp.vec3i, device=device),
            )
        return self.arrays[device.alias]


def topology_of(volume: SparseVolume) -> Topology:
    """The nodes of a volume's tree, cached per volume."""
    return volume._cache.find("topology", lambda: _find_topology(above_leaves(volume)))


def _find_topology(buffer: NDArray[np.uint8]) -> Topology:
    grid = grid_nodes(buffer)
    upper = grid.upper_places()
    lower = grid.upper.children(upper.origins)
    leaves = grid.lower.children(lower.origins)
    node, slot = (part.astype(np.int32) for part in set_bits(grid.lower.tile_mask))
    begins = grid.leaf.begin, grid.lower.begin
    return Topology(grid.leaf.layout, begins, lower, leaves, node, slot, large_tile_borders(grid, upper))
