"""Finds the cells of a sparse volume that an isosurface crosses, in its leaves and in the tiles beside them.

A cell counts if the trilinear interpolant takes the isovalue in it and one of its eight voxels is active. Tiles are not
expanded into voxels: a tile is only examined where it differs from its neighbors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.late_warp import wp
from geokit.core.memory.device_arena import Scratch
from geokit.core.memory.pinned import host_flags
from geokit.volume.isosurface.launch import GRAIN, fill_offsets, launch_even, require_memory
from geokit.volume.isosurface.nodes import Topology, topology_of
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.nodes import slot_places

# Byte offset of the voxels in a leaf of floats.
FLOAT_TABLE = 96
# Bytes of a block while its cells are found: planes, neighbors, places.
BLOCK_BYTES = 160
# Bytes of the float32 copy of a leaf of another type.
DECODED_BYTES = 2048
# Steps (dx, dy, dz) from a block to the eight blocks above it (or below, when subtracted), number 4 dx + 2 dy + dz.
STEPS = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1).astype(np.int32)


@dataclass(frozen=True)
class CrossedCells:
    """Inputs of the kernels that extract a mesh.

    Attributes:
        cells: The kernels' :class:`Cells`; it keeps its arrays alive.
        count: Number of blocks with crossed cells, which come first in ``cells.crossed``.
        device: Device of the arrays.
        tree: The kernels' :class:`Tree`.
        keep: Other objects that must outlive the kernels.
    """

    cells: Any
    tree: Any
    count: int
    device: "wp.Device"
    keep: tuple[Any, ...]


def crossed_cells(volume: SparseVolume, isovalue: float, device: Any) -> CrossedCells:
    """Find the blocks of 8^3 cells that the surface crosses.

    Args:
        volume: A scalar grid that :meth:`SparseVolume.on` accepts.
        isovalue: Value of the surface.
        device: A warp device.

    Returns:
        CrossedCells.

    Raises:
        DeviceMemoryError: There is not enough memory.
    """
    from geokit.volume.isosurface import cells_kernels as kernels

    grid = volume.on(device)
    topology = topology_of(volume)
    topology.large.require_countable(isovalue)
    leaves = len(topology.leaves.starts)
    require_memory(leaves * (BLOCK_BYTES + (0 if topology.is_float else DECODED_BYTES)), device)

    cells: Any = kernels.Cells()
    cells.volume = wp.uint64(grid.id)
    cells.leaf_count = leaves
    cells.leaf_offset, cells.origin = topology.on(device)[:2]
    lowers = len(topology.lower.starts)
    # One allocation for all, because creating an array costs the host as much as a GPU launch.
    sides, refs, below, tile_inside, around, *lists = Scratch(
        device,
        ((8 * leaves,), wp.uint64),
        ((8 * leaves,), wp.int32),
        ((leaves,), wp.uint8),
        ((64 * lowers,), wp.uint64),
        ((27 * lowers,), wp.int32),
        *_lists(leaves),
    ).arrays
    cells.sides, cells.refs = sides.warp, refs.warp
    keep = _find_sides(cells, topology, isovalue, device)
    tree = _tree(cells, topology, isovalue, device, tile_inside.warp, around.warp)
    some = host_flags(1, device)
    mixed, place, crossed, slot = lists
    launch_even(kernels.link_kernel, leaves, [cells, tree], [below, some, mixed], device, least=GRAIN)
    # Few level sets have border blocks. Without them the first wait is for the count of crossed blocks.
    found = [] if topology.has_tiles else fill_offsets([mixed], [place])
    if not found or some.numpy()[0]:
        _add_border_blocks(cells, tree, _border_origins(cells, tree, below, topology, isovalue, device), isovalue)
        mixed, place, crossed, slot = Scratch(device, *_lists(len(cells.origin))).arrays
        launch_even(kernels.mixed_kernel, len(mixed), [cells], [mixed], device, least=GRAIN)
        found = fill_offsets([mixed], [place])
    cells.crossed, cells.slot = crossed.warp, slot.warp
    launch_even(kernels.list_kernel, len(mixed), [mixed, place], [crossed, slot], device)
    return CrossedCells(cells, tree, found[0], device, (volume, grid, keep))


def _lists(blocks: int) -> list[tuple[tuple[int, ...], Any]]:
    """Shapes of four arrays about blocks: has crossed cells, prefix sum of that, list of such blocks, place in it."""
    return [((blocks,), wp.int32)] * 4


def _find_sides(cells: Any, topology: Topology, isovalue: float, device: Any) -> Any:
    """Fill in ``cells.sides`` and the location of float32 values; return an array that must be kept alive."""
    from geokit.volume.isosurface import cells_kernels as kernels

    count = cells.leaf_count
    keep = None
    if topology.is_float:
        first_leaf = int(topology.leaves.starts[0]) if count else 0
        cells.values = wp.uint64(int(cells.volume) + first_leaf + FLOAT_TABLE)
        cells.stride = wp.uint64(topology.layout.leaf_size)
        cells.isovalue = wp.float64(isovalue)
        # The smallest float32 that is not below the isovalue: comparing with it needs no float64.
        with np.errstate(over="ignore"):
            limit = np.float32(isovalue)
        if float(limit) < isovalue:
            limit = np.nextafter(limit, np.float32(np.inf))
    else:
        keep = wp.empty(512 * count, dtype=wp.float32, device=device)
        launch_even(kernels.decode_kernel, 64 * count, [cells, wp.float64(isovalue)], [keep], device)
        cells.values = wp.uint64(keep.ptr or 0)
        cells.stride = wp.uint64(DECODED_BYTES)
        cells.isovalue = wp.float64(0.0)
        limit = np.float32(0.0)
    # On a GPU a thread reads a row of eight voxels, on a CPU a whole leaf.
    if device.is_cuda:
        launch_even(kernels.row_sides_kernel, 64 * count, [cells, wp.float32(limit)], [], device)
    else:
        launch_even(kernels.leaf_sides_kernel, count, [cells, wp.float32(limit)], [], device, least=GRAIN)
    return keep


def _tree(
    cells: Any, topology: Topology, isovalue: float, device: Any, tile_inside: "wp.array", around: "wp.array"
) -> Any:
    """The kernels' struct of lower nodes, with ``tile_inside`` and ``around`` filled in."""
    from geokit.volume.isosurface import cells_kernels as kernels

    tree: Any = kernels.Tree()
    layout = topology.layout
    tree.leaf_begin, tree.begin = (wp.uint64(begin) for begin in topology.begins)
    tree.size = wp.uint64(layout.lower_size)
    tree.table = wp.uint64(layout.lower_table)
    tree.leaf_size = wp.uint64(0 if layout.leaf_bits < 0 else layout.leaf_size)
    _, _, tree.leaf_lower, tree.leaf_slot, origin = topology.on(device)
    count = len(origin)
    tree.tile_inside, tree.around = tile_inside, around
    inputs = [cells.volume, wp.float64(isovalue), tree]
    launch_even(kernels.tile_sides_kernel, 64 * count, inputs, [tree.tile_inside], device, least=GRAIN)
    launch_even(kernels.lower_neighbors_kernel, 27 * count, [*inputs, origin], [tree.around], device)
    return tree


def _border_origins(
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
    from geokit.volume.isosurface import cells_kernels as kernels

    found = [_blocks_below(topology.leaves.origins, leaf_below.numpy())]
    node, slot, large = topology.active_node, topology.active_slot, topology.large.blocks(isovalue)
    if len(node):
        below = wp.empty(len(node), dtype=wp.uint8, device=device)
        where = [wp.array(part, dtype=wp.int32, device=device) for part in (node, slot)]
        launch_even(kernels.tile_border_kernel, len(node), [cells, tree, *where], [below], device)
        found.append(_blocks_below(topology.lower.origins[node] + 8 * slot_places(slot, 16), below.numpy()))
    if len(large):
        below = wp.empty(len(large), dtype=wp.uint8, device=device)
        inputs = [cells.volume, wp.float64(isovalue), wp.array(large, dtype=wp.vec3i, device=device)]
        launch_even(kernels.large_tile_border_kernel, len(large), inputs, [below], device)
        found.append(_blocks_below(large, below.numpy()))
    origins = np.concatenate(found)
    return np.unique(origins, axis=0) if len(origins) else origins


def _blocks_below(origins: NDArray[np.int32], below: NDArray[np.uint8]) -> NDArray[np.int32]:
    """First voxels of the blocks below each origin whose bits are set, by direction."""
    rows = np.flatnonzero(below)
    bits = np.unpackbits(below[rows, None], axis=1, bitorder="little")
    row, step = np.nonzero(bits)
    return np.asarray(origins[rows[row]] - 8 * STEPS[step])


def _add_border_blocks(cells: Any, tree: Any, origins: NDArray[np.int32], isovalue: float) -> None:
    from geokit.volume.isosurface import cells_kernels as kernels

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
