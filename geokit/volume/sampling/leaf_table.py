"""Builds the leaf table of a float grid on a device, after enough queries, and keeps it with the volume."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.launches import captured, prepared
from geokit.core.memory.available_memory import available

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

# Filling an entry takes a quarter of the time of a query through the tree, and the table saves half of a query's time.
# So the table pays once it has at most this many entries per query so far.
ENTRIES_PER_QUERY = 2
# Fewest bytes of a lower node with its leaves: bounds how many lower nodes a grid of a given size can hold.
LOWER_NODE = 1 << 15
# Most places of 128^3 voxels in the box: 4 MiB of entries. Grids scattered over a larger box are queried by tree walks.
LARGEST_BOX = 1 << 20
# Bytes of a grid: an entry addresses a tile's value by 31 bits, in units of four bytes.
LARGEST_GRID = 1 << 33
SPAN = 128
# A leaf's bytes divided by 32: the entries of consecutive leaves differ by it.
LEAF_ENTRIES = 67
# Share of a GPU's free memory that the pairs of a volume may take. Pairs take two and a half times the leaves' memory.
PAIRS_SHARE = 0.25


def leaf_table(volume: SparseVolume, device: "wp.Device", count: int) -> Any:
    """The LeafTable of a volume; None if the grid has none, or if it does not pay yet.

    Args:
        volume: A grid. Only "float" grids have tables.
        device: Device of the table.
        count: Number of queries in this call.
    """
    key = f"leaf table {device.alias}"
    if key in volume._uploads:
        return volume._uploads[key]
    box = _box(volume)
    if box is None:
        return None
    volume.on(device)  # checks the grid before its contents are used
    # Queries add up over calls, so many small calls count like one large call.
    asked = f"queries on {device.alias}"
    volume._uploads[asked] = volume._uploads.get(asked, 0) + count
    if captured.is_captured(device) or volume._uploads[asked] * ENTRIES_PER_QUERY < _most_entries(volume, *box):
        return None
    prepared.refuse()
    return volume._uploads.setdefault(key, _make(volume, device, *box))


def made_table(volume: SparseVolume, device: "wp.Device") -> Any:
    """The LeafTable of a volume if it has been made; this counts as no query."""
    return volume._uploads.get(f"leaf table {device.alias}")


def _box(volume: SparseVolume) -> tuple[np.ndarray, np.ndarray] | None:
    """First voxel and size, in steps of 128 voxels, of a box around the active voxels; None if no table can hold it."""
    info = volume.info
    if info.grid_type != "float" or info.index_bounds is None or info.byte_count > LARGEST_GRID:
        return None
    first = info.index_bounds[0] // SPAN
    last = info.index_bounds[1] // SPAN
    # Queries also lie around a body; an empty place costs one entry only.
    margin = 1 + (last - first + 1) // 2
    first, last = first - margin, last + margin
    size = last - first + 1
    # Kernels compute indices in int32, and a cell's far corner may lie one voxel beyond the box.
    limits = np.iinfo(np.int32)
    if size.prod(dtype=np.float64) > LARGEST_BOX or (first * SPAN < limits.min).any():
        return None
    if ((first + size) * SPAN > limits.max - SPAN).any():
        return None
    return first * SPAN, size


def _most_entries(volume: SparseVolume, first: np.ndarray, size: np.ndarray) -> int:
    """Upper bound of the table's entries, from the most lower nodes that the active box and the grid's bytes allow."""
    bounds = volume.info.index_bounds
    assert bounds is not None
    active = int((bounds[1] // SPAN - bounds[0] // SPAN + 1).prod())
    return int(size.prod()) + 4096 * min(active, volume.info.byte_count // LOWER_NODE)


def _make(
    volume: SparseVolume, device: "wp.Device", lower: np.ndarray, size: np.ndarray, *, with_pairs: bool = True
) -> Any:
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
    if device.is_cuda and with_pairs:
        add_pairs(table, listed, int(PAIRS_SHARE * available(device)))
    return table


def add_pairs(table: Any, places: "wp.array", memory: int) -> None:
    """Add ``pairs`` to a table, unless they need more than ``memory`` bytes.

    Sampling on a GPU is bound by the 32-byte sectors that a cell touches: four and a half in a leaf, two and a half in
    the pairs.
    """
    from geokit.volume.sampling import leaf_table_kernels as kernels

    device = table.slots.device
    entries = table.slots.numpy()
    leaves = entries[entries >= 0]
    if not len(leaves):
        return
    table.first_leaf = int(leaves.min())
    count = (int(leaves.max()) - table.first_leaf) // LEAF_ENTRIES + 1
    if 8 * kernels.PAIRS * count > memory or 2 * kernels.PAIRS * count > np.iinfo(np.int32).max:
        return
    corners = wp.full(count, wp.vec3i(*map(int, table.lower)), dtype=wp.vec3i, device=device)
    launcher.launch(kernels.leaf_corners_kernel, len(entries), [table, places], [corners], device)
    pairs = wp.empty(2 * kernels.PAIRS * count, dtype=wp.float32, device=device)
    launcher.launch(kernels.fill_pairs_kernel, kernels.PAIRS * count, [table, corners], [pairs], device)
    table.pairs = pairs
