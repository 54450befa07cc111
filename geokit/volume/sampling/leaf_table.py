"""The table of a float grid's leaves on a device, made after enough queries and kept with the volume."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import launcher

if TYPE_CHECKING:
    import warp as wp

    from geokit.volume._model import SparseVolume

__all__ = ["leaf_table"]

# An entry takes a quarter of the time of a query through the tree, and the table saves half of that: it is worth making
# once it has at most so many entries for each query so far.
ENTRIES_PER_QUERY = 2
# Bytes of a lower node without the eighth of a leaf that it has at least: how many a grid of a size can hold.
LOWER_NODE = 1 << 15
# Places of 128^3 voxels in the box: 4 MiB. Grids that lie scattered over a larger one are searched through their tree.
LARGEST_BOX = 1 << 20
# Bytes of a grid whose tiles 31 bits can tell apart.
LARGEST_GRID = 1 << 33
SPAN = 128
# A leaf's bytes divided by 32: entries of neighboring leaves differ by it.
LEAF_ENTRIES = 67
# Of a GPU's free memory, what the pairs of a volume may take: they are two and a half times its leaves.
PAIRS_SHARE = 0.25


def leaf_table(volume: SparseVolume, device: "wp.Device", count: int) -> Any:
    """The LeafTable of a volume, or None where there is none or ``count`` queries are too few to make it.

    Args:
        volume: A grid; of any type but "float" there is no table.
        device: Where its table is wanted.
        count: Number of queries that are waiting.
    """
    key = f"leaf table {device.alias}"
    if key in volume._uploads:
        return volume._uploads[key]
    box = _box(volume)
    if box is None:
        return None
    volume.on(device)  # checks the grid before its contents are used
    # Many small calls count as much as a large one.
    asked = f"queries on {device.alias}"
    volume._uploads[asked] = volume._uploads.get(asked, 0) + count
    if volume._uploads[asked] * ENTRIES_PER_QUERY < _most_entries(volume, *box):
        return None
    table = volume._uploads[key] = _make(volume, device, *box)
    return table


def _box(volume: SparseVolume) -> tuple[np.ndarray, np.ndarray] | None:
    """First voxel, and size in places, of a box around the active voxels."""
    info = volume.info
    if info.grid_type != "float" or info.index_bounds is None or info.byte_count > LARGEST_GRID:
        return None
    first = info.index_bounds[0] // SPAN
    last = info.index_bounds[1] // SPAN
    # Queries lie around a body too: empty places cost an entry each.
    margin = 1 + (last - first + 1) // 2
    first, last = first - margin, last + margin
    size = last - first + 1
    # Index arithmetic in kernels is int32, and a cell's far corner one beyond the box.
    limits = np.iinfo(np.int32)
    if size.prod(dtype=np.float64) > LARGEST_BOX or (first * SPAN < limits.min).any():
        return None
    if ((first + size) * SPAN > limits.max - SPAN).any():
        return None
    return first * SPAN, size


def _most_entries(volume: SparseVolume, first: np.ndarray, size: np.ndarray) -> int:
    """Entries of the table, if there are as many lower nodes as the active box and the bytes have room for."""
    bounds = volume.info.index_bounds
    assert bounds is not None
    active = int((bounds[1] // SPAN - bounds[0] // SPAN + 1).prod())
    return int(size.prod()) + 4096 * min(active, volume.info.byte_count // LOWER_NODE)


def _make(volume: SparseVolume, device: "wp.Device", lower: np.ndarray, size: np.ndarray) -> Any:
    import warp as wp

    from geokit.volume.sampling import leaf_table_kernels as kernels

    handle = wp.uint64(volume.id(device))
    where = [wp.vec3i(*lower.tolist()), wp.vec3i(*size.tolist())]
    count = int(size.prod())
    top = wp.empty(count, dtype=wp.int32, device=device)
    launcher.launch(kernels.fill_top_kernel, count, [handle, *where], [top], device)
    starts = top.numpy()
    places = np.flatnonzero(starts == 0)
    entries = 4096 * len(places)
    if entries > np.iinfo(np.int32).max:
        return None
    starts[places] = 4096 * np.arange(len(places))
    slots = wp.empty(entries, dtype=wp.int32, device=device)
    listed = wp.array(places.astype(np.int32), dtype=wp.int32, device=device)
    launcher.launch(kernels.fill_slots_kernel, entries, [handle, *where, listed], [slots], device)
    table = kernels.LeafTable()
    table.grid = wp.uint64(volume._uploads[device.alias][1].ptr)
    table.lower, table.size = where
    table.top = wp.array(starts, dtype=wp.int32, device=device)
    table.slots = slots
    if device.is_cuda:
        add_pairs(table, listed, int(PAIRS_SHARE * device.free_memory))
    return table


def add_pairs(table: Any, places: "wp.array", memory: int) -> None:
    """Give a table its ``pairs``, unless they need more than ``memory`` bytes.

    A GPU is as quick as the 32-byte sectors of the cells come: of a leaf as it is a cell touches four and a half, of
    pairs two and a half.
    """
    import warp as wp

    from geokit.volume.sampling import leaf_table_kernels as kernels

    device = table.slots.device
    entries = table.slots.numpy()
    leaves = entries[entries >= 0]
    if not len(leaves):
        return
    table.first_leaf = int(leaves.min())
    count = (int(leaves.max()) - table.first_leaf) // LEAF_ENTRIES + 1
    if 8 * kernels.PAIRS * count > memory or kernels.PAIRS * count > np.iinfo(np.int32).max:
        return
    corners = wp.full(count, wp.vec3i(*map(int, table.lower)), dtype=wp.vec3i, device=device)
    launcher.launch(kernels.leaf_corners_kernel, len(entries), [table, places], [corners], device)
    pairs = wp.empty(2 * kernels.PAIRS * count, dtype=wp.float32, device=device)
    launcher.launch(kernels.fill_pairs_kernel, kernels.PAIRS * count, [table, corners], [pairs], device)
    table.pairs = pairs
