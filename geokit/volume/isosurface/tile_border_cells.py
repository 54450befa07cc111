"""Finds border blocks: blocks of tiles, beside leaves or other tiles, with cells that an isosurface crosses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.volume.isosurface.launch import launch_even, require_memory
from geokit.volume.isosurface.nodes import Topology
from geokit.volume.nanovdb.nodes import slot_places

if TYPE_CHECKING:
    import warp as wp

__all__ = ["add_border_blocks", "border_origins"]

# Steps (dx, dy, dz) from a block to the eight blocks above it (or below, when subtracted), number 4 dx + 2 dy + dz.
# Bytes of a border block: planes, neighbors, places.
BLOCK_BYTES = 160
STEPS = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1).astype(np.int32)


def border_origins(
    cells: Any, tree: Any, leaf_below: "wp.array", topology: Topology, isovalue: float, device: "wp.Device"
) -> NDArray[np.int32]:
    """First voxels of the blocks of tiles that may have crossed cells, sorted, shape (R, 3).

    Args:
        cells: The kernels' struct of blocks.
        tree: The kernels' struct of nodes.
        leaf_below: Bit masks by direction from link_kernel, of the tiles below each leaf.
        topology: The nodes of the volume.
        isovalue: Value of the surface.
        device: Device of the arrays.
    """
    import warp as wp

    from geokit.volume.isosurface import tile_border_cells_kernels as kernels

    found = [_below(topology.leaves.origins, leaf_below.numpy())]
    node, slot, large = topology.active_node, topology.active_slot, topology.large.blocks(isovalue)
    if len(node):
        below = wp.empty(len(node), dtype=wp.uint8, device=device)
        where = [wp.array(part, dtype=wp.int32, device=device) for part in (node, slot)]
        launch_even(kernels.tile_border_kernel, len(node), [cells, tree, *where], [below], device)
        found.append(_below(topology.lower.origins[node] + 8 * slot_places(slot, 16), below.numpy()))
    if len(large):
        below = wp.empty(len(large), dtype=wp.uint8, device=device)
        inputs = [cells.volume, wp.float64(isovalue), wp.array(large, dtype=wp.vec3i, device=device)]
        launch_even(kernels.large_tile_border_kernel, len(large), inputs, [below], device)
        found.append(_below(large, below.numpy()))
    origins = np.concatenate(found)
    return np.unique(origins, axis=0) if len(origins) else origins


def _below(origins: NDArray[np.int32], below: NDArray[np.uint8]) -> NDArray[np.int32]:
    """First voxels of the blocks below each origin whose bits are set, by direction."""
    rows = np.flatnonzero(below)
    bits = np.unpackbits(below[rows, None], axis=1, bitorder="little")
    row, step = np.nonzero(bits)
    return np.asarray(origins[rows[row]] - 8 * STEPS[step])


def add_border_blocks(cells: Any, tree: Any, origins: NDArray[np.int32], isovalue: float) -> None:
    import warp as wp

    from geokit.volume.isosurface import tile_border_cells_kernels as kernels

    device = cells.origin.device
    count, blocks = cells.leaf_count, len(origins)
    if not blocks:
        return
    require_memory(blocks * BLOCK_BYTES, device)
    cells.border_active = wp.empty(blocks, dtype=wp.uint8, device=device)
    cells.origin = wp.array(np.concatenate([cells.origin.numpy(), origins]), dtype=wp.vec3i, device=device)
    for name in ("sides", "refs"):
        few = getattr(cells, name)
        more = wp.empty(8 * (count + blocks), dtype=few.dtype, device=device)
        if count:
            wp.copy(more, few, count=8 * count)
        setattr(cells, name, more)
    inputs = [cells, tree, wp.float64(isovalue), blocks]
    launch_even(kernels.border_block_kernel, blocks, inputs, [cells.sides, cells.border_active, cells.refs], device)
    launch_even(kernels.link_border_blocks_kernel, 8 * count, [cells, blocks], [cells.refs], device)
