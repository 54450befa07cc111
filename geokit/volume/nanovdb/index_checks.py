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
from geokit.volume.nanovdb.header import FLAG_BREADTH_FIRST, Damage, grid_header, require_header, version_text
from geokit.volume.nanovdb.layout import INDEX_LAYOUTS, LEAF_VOXELS, GridLayout, type_name
from geokit.volume.nanovdb.nodes import GridNodes, NodeLevel, bits_of

# First version, packed as in NanoVDB, whose leaves have an offset and prefix sums.
FIRST_VERSION = 32 << 21 | 6 << 10
LEAF_FLAGS = 15
LEAF_OFFSET = 80
LEAF_PREFIX = 88
# Leaves with statistics store their minimum, maximum, average and deviation directly after their voxels.
HAS_STATISTICS = 16
STATISTICS = 4


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


def leaf_offsets(leaf: NodeLevel) -> NDArray[np.uint64]:
    """The index of the first voxel of each leaf, (L,)."""
    return np.asarray(leaf.column("<u8", LEAF_OFFSET, 1)[:, 0])


def check_indices(grid: GridNodes) -> None:
    """Check the indices of an index grid whose nodes are already checked."""
    values = value_count_of(grid.root.buffer)
    if int(grid.background) >= max(values, 1):
        raise Damage(f"the background's index is not below its {values} values")
    if (grid.table["value"][grid.table["child"] == 0] >= values).any():
        raise Damage(f"a tile of the root has an index that is not below its {values} values")
    for level in (grid.upper, grid.lower):
        for _, part in level.parts():
            if ((part.values >= values) & ~bits_of(part.child_mask)).any():
                raise Damage(f"a tile has an index that is not below its {values} values")
    if grid.leaf.count:
        _check_leaves(grid.leaf, values)


def _check_leaves(leaf: NodeLevel, values: int) -> None:
    count, offset, prefix = leaf.count, leaf_offsets(leaf), leaf.column("<u8", LEAF_PREFIX, 1)
    flags = leaf.column(np.uint8, LEAF_FLAGS, 1)[:, 0]
    used = np.full(count, LEAF_VOXELS, np.uint64)
    if leaf.layout.name.startswith("on"):
        sums = (
            bits_of(leaf.value_mask).reshape(count, 8, 64).sum(axis=2, dtype=np.uint64).cumsum(axis=1, dtype=np.uint64)
        )
        used = sums[:, 7]
        # Readers add these prefix sums to the offset unchecked: a wrong one leads out of the leaf's range.
        shifts = np.arange(7, dtype=np.uint64) * np.uint64(9)
        if ((prefix >> shifts & np.uint64(511)) != (sums[:, :7] & np.uint64(511))).any():
            raise Damage("the prefix sums of a leaf do not fit its mask")
    used = used + np.where(flags & HAS_STATISTICS, np.uint64(STATISTICS), np.uint64(0))
    # Compared in this order, since adding to a damaged offset could wrap around.
    if (used > values).any() or (offset > np.uint64(values) - used).any():
        raise Damage(f"a leaf has indices that are not below its {values} values")
