"""Index grids: the layout of their nodes, and checks that every index lies in the range that the grid claims.

An index grid stores no values. Each voxel and tile has an index into channels, which are arrays that follow the nodes
as blind data. Index 0 belongs to the background. A leaf numbers its voxels consecutively from its own offset: all 512
of them ("index"), or only the active ones ("onindex").

Source:
    NanoVDB (Museth 2021), NanoVDB.h 32.8, LeafIndexBase. Before 32.6 leaves of index grids were laid out differently.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geokit.errors import UnsupportedGridError
from geokit.volume.nanovdb.header import FLAG_BREADTH_FIRST, grid_header, require_header, version_text
from geokit.volume.nanovdb.layout import (
    INDEX_LAYOUTS,
    LEAF_VOXELS,
    LOWER_SLOTS,
    UPPER_SLOTS,
    GridLayout,
    type_name,
)

__all__ = ["index_damage", "index_layout", "leaf_offsets", "masks_of", "slots_of", "value_count_of"]

# First version, packed as in NanoVDB, whose leaves have an offset and prefix sums.
FIRST_VERSION = 32 << 21 | 6 << 10
LEAF_FLAGS = 15
LEAF_MASK = 16
LEAF_OFFSET = 80
LEAF_PREFIX = 88
# Leaves with statistics store their minimum, maximum, average and deviation directly after their voxels.
HAS_STATISTICS = 16
STATISTICS = 4
# Nodes checked together: the slots of 64 upper nodes are 16 megabytes.
NODES_AT_A_TIME = 64


def index_layout(head: NDArray[np.uint8], where: str) -> GridLayout | None:
    """Layout of an index grid, from its header; None for other grids.

    Raises:
        FileFormatError: The bytes are not a NanoVDB grid, or its header contradicts itself.
        UnsupportedGridError: It is an index grid of a version whose leaves are laid out differently.
    """
    require_header(head, where)
    grid = grid_header(head)
    layout = INDEX_LAYOUTS.get(type_name(int(grid["grid_type"])))
    if layout is None:
        return None
    if int(grid["version"]) < FIRST_VERSION or not int(grid["flags"]) & FLAG_BREADTH_FIRST:
        raise UnsupportedGridError(
            f"{where}: the {layout.name} grid is of NanoVDB {version_text(int(grid['version']))}, or its nodes are not "
            "in breadth-first order; write it again with NanoVDB 32.6 or later"
        )
    return layout


def value_count_of(buffer: NDArray[np.uint8]) -> int:
    """Number of values that each channel of an index grid must have."""
    return int(grid_header(buffer)["data_1"])


def masks_of(buffer: NDArray[np.uint8], begin: int, count: int, size: int, at: int, slots: int) -> NDArray[np.uint8]:
    """Stored bit masks of consecutive nodes, shape (count, slots / 8), sharing the buffer's memory."""
    return np.ndarray((count, slots // 8), np.uint8, buffer, begin + at, (size, 1))


def slots_of(
    buffer: NDArray[np.uint8], begin: int, count: int, size: int, table: int, slots: int
) -> tuple[NDArray[np.uint64], NDArray[np.bool_]]:
    """Slots (count, slots) of consecutive nodes of an index grid, and the mask of those that hold children."""
    entries = np.ndarray((count, slots), "<u8", buffer, begin + table, (size, 8))
    children = masks_of(buffer, begin, count, size, 32 + slots // 8, slots)
    return entries, np.unpackbits(children, axis=1, bitorder="little").view(np.bool_)


def leaf_offsets(
    buffer: NDArray[np.uint8], begin: int, count: int, layout: GridLayout
) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """The index of the first voxel (L,) of consecutive leaves, and their prefix sums (L,)."""
    strides = (layout.leaf_size,)
    return (
        np.ndarray((count,), "<u8", buffer, begin + LEAF_OFFSET, strides),
        np.ndarray((count,), "<u8", buffer, begin + LEAF_PREFIX, strides),
    )


def index_damage(
    buffer: NDArray[np.uint8], layout: GridLayout, root: int, upper: tuple[int, int], lower: tuple[int, int],
    leaf: tuple[int, int],
) -> str | None:  # fmt: skip
    """Describe what is wrong with the indices of a grid whose nodes are already checked; None if they are valid.

    Args:
        buffer: The whole grid.
        layout: One of INDEX_LAYOUTS.
        root: Offset of the root.
        upper: Offset and number of the upper nodes; likewise ``lower`` and ``leaf``.
    """
    values = value_count_of(buffer)
    at = root + layout.root_background
    if int(buffer[at : at + 8].view("<u8")[0]) >= max(values, 1):
        return f"the background's index is not below its {values} values"
    tiles = int(buffer[root + 24 : root + 28].view("<u4")[0])
    table = buffer[root + layout.root_size : root + layout.root_size + tiles * layout.root_tile_size]
    table = table.reshape(tiles, layout.root_tile_size)
    child, index = table[:, 8:16].copy().view("<i8")[:, 0], table[:, 24:32].copy().view("<u8")[:, 0]
    if (index[child == 0] >= values).any():
        return f"a tile of the root has an index that is not below its {values} values"
    for (begin, count), size, start, slots in (
        (upper, layout.upper_size, layout.upper_table, UPPER_SLOTS),
        (lower, layout.lower_size, layout.lower_table, LOWER_SLOTS),
    ):
        for first in range(0, count, NODES_AT_A_TIME):
            some = min(NODES_AT_A_TIME, count - first)
            entries, children = slots_of(buffer, begin + first * size, some, size, start, slots)
            if ((entries >= values) & ~children).any():
                return f"a tile has an index that is not below its {values} values"
    return _leaf_damage(buffer, layout, *leaf, values)


def _leaf_damage(buffer: NDArray[np.uint8], layout: GridLayout, begin: int, count: int, values: int) -> str | None:
    if not count:
        return None
    offset, prefix = leaf_offsets(buffer, begin, count, layout)
    flags = np.ndarray((count,), np.uint8, buffer, begin + LEAF_FLAGS, (layout.leaf_size,))
    used = np.full(count, LEAF_VOXELS, np.uint64)
    if layout.name.startswith("on"):
        bits = np.unpackbits(masks_of(buffer, begin, count, layout.leaf_size, LEAF_MASK, LEAF_VOXELS), axis=1)
        sums = bits.reshape(count, 8, 64).sum(axis=2, dtype=np.uint64).cumsum(axis=1, dtype=np.uint64)
        used = sums[:, 7]
        # Readers add these prefix sums to the offset unchecked: a wrong one leads out of the leaf's range.
        shifts = np.arange(7, dtype=np.uint64) * np.uint64(9)
        if ((prefix[:, None] >> shifts & np.uint64(511)) != (sums[:, :7] & np.uint64(511))).any():
            return "the prefix sums of a leaf do not fit its mask"
    used = used + np.where(flags & HAS_STATISTICS, np.uint64(STATISTICS), np.uint64(0))
    # Compared in this order, since adding to a damaged offset could wrap around.
    if (used > values).any() or (offset > np.uint64(values) - used).any():
        return f"a leaf has indices that are not below its {values} values"
    return None
