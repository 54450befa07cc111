"""What stands before the nodes of a grid: headers, root and the root's table, written on the host."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError
from geokit.volume.nanovdb.header import HEAD_SIZE, aligned_buffer, tree_header
from geokit.volume.nanovdb.header_options import GridOptions, checked_options, write_header
from geokit.volume.nanovdb.layout import GRID_TYPES, GridLayout, layout_of
from geokit.volume.tree.node_places import root_keys_of, root_span, with_gaps

__all__ = ["GridHead", "Places", "checked_head", "places_of", "write_head", "write_root"]


@dataclass(frozen=True)
class GridHead:
    """What a grid is to be, apart from its voxels: type, background, inside value, and what its header says."""

    layout: GridLayout
    background: float
    inside: float
    options: GridOptions

    @property
    def word(self) -> np.dtype[Any]:
        """NumPy type of a value."""
        return self.layout.background


@dataclass(frozen=True)
class Places:
    """Where the nodes of a grid go: numbers of nodes, the byte at which each kind begins, and the root's table.

    Attributes:
        counts: Leaves, lower nodes and upper nodes.
        root_keys: Keys of the root's table, ascending.
        root_child: Upper node of each entry, -1 for a tile.
        gaps: Entries between two upper nodes along z, as (row, upper node below, upper node above).
        size: Bytes of the grid.
    """

    counts: tuple[int, int, int]
    root_keys: NDArray[np.uint64]
    root_child: NDArray[np.int64]
    gaps: list[tuple[int, int, int]]
    upper_begin: int
    lower_begin: int
    leaf_begin: int
    size: int


def checked_head(
    grid_type: str, background: float, inside: float, transform: NDArray[np.float64], name: str, grid_class: str
) -> GridHead:
    """The options of a grid, refused where no grid can have them.

    Raises:
        InputError: A name, class, background or transform that no grid can have.
    """
    options = checked_options(transform, name, grid_class)
    if not (np.isfinite(background) and np.isfinite(inside)):
        raise InputError(f"background: {background} is not finite; give a number")
    return GridHead(layout_of(GRID_TYPES.index(grid_type), "grid"), background, inside, options)


def places_of(layout: GridLayout, leaves: int, lowers: int, uppers: NDArray[np.int64], *, fill_gaps: bool) -> Places:
    """Places of the nodes.

    Args:
        layout: Of the grid's type.
        leaves: Number of leaves.
        lowers: Number of lower nodes.
        uppers: Coordinates of the upper nodes in units of themselves, in the order of their keys, shape (U, 3).
        fill_gaps: Reserve root tiles between upper nodes along z.
    Raises:
        InputError: The upper nodes are too far apart to be filled in between.
    """
    keys, child, gaps = with_gaps(root_keys_of(uppers << 12), fill_gaps)
    upper_begin = HEAD_SIZE + layout.root_size + len(keys) * layout.root_tile_size
    lower_begin = upper_begin + len(uppers) * layout.upper_size
    leaf_begin = lower_begin + lowers * layout.lower_size
    size = leaf_begin + leaves * layout.leaf_size
    return Places((leaves, lowers, len(uppers)), keys, child, gaps, upper_begin, lower_begin, leaf_begin, size)


def write_head(head: GridHead, places: Places, upper_faces: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Headers, root and the root's table, still without statistics and checksum.

    Args:
        head: What the grid is to be.
        places: Where its nodes are.
        upper_faces: For each upper node a bit for each face, -x +x -y +y -z +z: whether it lies inside, shape (U,).
    """
    buffer = aligned_buffer(places.upper_begin, zeroed=True)
    begins = (places.leaf_begin, places.lower_begin, places.upper_begin, HEAD_SIZE)
    write_header(buffer, head.layout, head.options, places.size, begins, places.counts)
    buffer[HEAD_SIZE + 24 : HEAD_SIZE + 28].view("<u4")[0] = len(places.root_keys)
    table = _root_table(buffer, head, len(places.root_keys))
    table["key"] = places.root_keys
    table["value"] = head.background
    to_upper = places.upper_begin - HEAD_SIZE + places.root_child * head.layout.upper_size
    table["child"] = np.where(places.root_child >= 0, to_upper, 0)
    for row, below, above in places.gaps:
        # Both ends of a gap along z show whether it lies inside: faces 5 (upper z) and 4 (lower z).
        if upper_faces[below] >> 5 & 1 and upper_faces[above] >> 4 & 1:
            table["value"][row] = head.inside
    return buffer


def _root_table(buffer: NDArray[np.uint8], head: GridHead, count: int) -> NDArray[np.void]:
    entry = np.dtype(
        {
            "names": ["key", "child", "state", "value"],
            "formats": ["<u8", "<i8", "<u4", head.word],
            "offsets": [0, 8, 16, 20],
            "itemsize": head.layout.root_tile_size,
        }
    )
    begin = HEAD_SIZE + head.layout.root_size
    return np.ndarray((count,), entry, buffer, begin)


def write_root(
    buffer: NDArray[np.uint8], head: GridHead, boxes: NDArray[np.int32], extrema: NDArray[Any], active: int
) -> None:
    """Statistics of the whole grid from those of its upper nodes: boxes (U, 2, 3) and extrema (U, 2)."""
    root = buffer[HEAD_SIZE:]
    box = root[:24].view("<i4").reshape(2, 3)
    box[0], box[1] = np.iinfo(np.int32).max, np.iinfo(np.int32).min
    some = boxes[:, 0, 0] <= boxes[:, 1, 0]
    limits = np.full(2, head.background, head.word)
    if some.any():
        box[0], box[1] = boxes[some, 0].min(axis=0), boxes[some, 1].max(axis=0)
        limits[:] = extrema[some, 0].min(), extrema[some, 1].max()
    root[head.layout.root_background : head.layout.root_background + 12].view(head.word)[:] = (head.background, *limits)
    tree_header(buffer)["voxel_count"] = active
    root_span(buffer, box if some.any() else None)
