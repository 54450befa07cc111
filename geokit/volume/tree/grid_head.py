"""The part of a grid before its nodes (headers, root and root table), written on the host."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.grid_info import GridInfo
from geokit.volume.nanovdb.header import (
    FLAG_HAS_BBOX,
    FLAG_LONG_NAME,
    GRID_DATA,
    HEAD_SIZE,
    LONGEST_NAME,
    TREE_OFFSET,
    GridOptions,
    aligned_buffer,
    checked_options,
    encoded_name,
    grid_class_code,
    grid_header,
    grid_name,
    info_of,
    tree_header,
    write_header,
    write_transform,
)
from geokit.volume.nanovdb.layout import LAYOUTS, GridLayout
from geokit.volume.nanovdb.nodes import grid_nodes

# Largest number of tiles between upper nodes: they are 2 MiB and cover 2.7e8 voxels of solid along an axis.
LARGEST_GAP_TILES = 1 << 16
# Bits of a coordinate in the key of a root entry.
ROOT_BITS = 20
# For each corner of a box, which end it has along each axis; the box of nothing.
_CORNERS = np.indices((2, 2, 2)).reshape(3, -1)
_NO_BOX = np.repeat([np.finfo(np.float64).max, np.finfo(np.float64).min], 3)


@dataclass(frozen=True)
class GridHead:
    """Specification of a grid, apart from its voxels.

    Attributes:
        layout: Layout of the grid's type.
        background: Value outside all nodes, a number, or an array if the type has vectors.
        inside: Value of empty regions inside a level set.
        options: Transform, name and class.
        header: First bytes of a grid whose transform, name and class are kept bit by bit; None if ``options`` define
            them.
    """

    layout: GridLayout
    background: Any
    inside: Any
    options: GridOptions
    header: NDArray[np.uint8] | None = None

    @property
    def word(self) -> np.dtype[Any]:
        """NumPy type of a value."""
        return self.layout.background

    @property
    def has_long_name(self) -> bool:
        """Whether the name is too long for the header and follows the nodes."""
        if self.header is not None:
            return bool(int(self.header.view(GRID_DATA)["flags"][0]) & FLAG_LONG_NAME)
        return len(self.options.name) > LONGEST_NAME


@dataclass(frozen=True)
class Places:
    """Positions of the nodes of a grid: their numbers, the offset of each kind, and the root table.

    Attributes:
        counts: Numbers of leaves, lower nodes and upper nodes.
        root_keys: Keys of the root table, ascending.
        root_child: Upper node of each entry, -1 for a tile.
        gaps: Entries between two upper nodes along z, as (row, upper node below, upper node above).
        size: Size of the grid in bytes.
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
    grid_type: str, background: Any, inside: Any, transform: NDArray[np.float64], name: str, grid_class: str
) -> GridHead:
    """Validate the options of a grid and return its head.

    Raises:
        InputError: A name, class, background or transform that no grid can have.
    """
    options = checked_options(transform, name, grid_class)
    if not (np.isfinite(background).all() and np.isfinite(inside).all()):
        raise InputError(f"background: {background} is not finite; give a number")
    return GridHead(LAYOUTS[grid_type], background, inside, options)


def head_like(
    volume: SparseVolume, layout: GridLayout, background: Any, transform: NDArray[np.float64] | None = None
) -> GridHead:
    """The head of a grid with the name, class and (unless one is given) the transform of another grid."""
    header = volume.nanovdb[:TREE_OFFSET]
    if transform is not None:
        header = header.copy()
        write_transform(header.view(GRID_DATA)[0], transform)
    name = encoded_name(grid_name(volume.nanovdb))
    matrix = volume.info.transform if transform is None else transform
    options = GridOptions(matrix, name, int(grid_header(volume.nanovdb)["grid_class"]))
    return GridHead(layout, background, background, options, header)


def result_head(
    volume: SparseVolume, layout: GridLayout, background: Any, grid_class: str, transform: NDArray[np.float64]
) -> GridHead:
    """The head of an operation's result: the name of a volume, with another class and transform.

    A class that NanoVDB does not allow for the type becomes "unknown".
    """
    if layout.background.shape and grid_class == "level set":
        grid_class = "unknown"
    options = GridOptions(transform, encoded_name(volume.info.name), grid_class_code(grid_class))
    kind = layout.background
    outside = np.array(np.broadcast_to(background, kind.shape), kind.base)
    return GridHead(layout, outside, -outside, options)


def volume_from_buffer(buffer: NDArray[np.uint8], like: SparseVolume) -> SparseVolume:
    """Wrap an operation's buffer as a volume with the metadata of the operation's first operand."""
    buffer.setflags(write=False)
    info = info_like(info_of(buffer), like)
    grid_class = str(info.metadata.get("class", info.grid_class))
    return SparseVolume(buffer, replace(info, grid_class=grid_class))


def info_like(info: GridInfo, like: SparseVolume) -> GridInfo:
    """The description of an operation's grid, with the metadata of its first operand."""
    metadata = dict(like.info.metadata)
    # Results of operations are not integers, so the mark of an integer type is dropped.
    metadata.pop("geokit:value_type", None)
    # A class that NanoVDB does not allow for the type is kept as metadata; it does not apply to another type.
    if info.grid_type != like.info.grid_type:
        metadata.pop("class", None)
    return replace(info, metadata=MappingProxyType(metadata))


def places_of(layout: GridLayout, leaves: int, lowers: int, uppers: NDArray[np.int64], *, fill_gaps: bool) -> Places:
    """Compute the positions of the nodes.

    Args:
        layout: Layout of the grid's type.
        leaves: Number of leaves.
        lowers: Number of lower nodes.
        uppers: Coordinates of the upper nodes in units of themselves, in the order of their keys, shape (U, 3).
        fill_gaps: Whether to reserve root tiles between upper nodes along z.
    Raises:
        InputError: The upper nodes are too far apart to fill the gaps between them.
    """
    keys, child, gaps = with_gaps(root_keys_of(uppers << 12), fill_gaps)
    upper_begin = HEAD_SIZE + layout.root_size + len(keys) * layout.root_tile_size
    lower_begin = upper_begin + len(uppers) * layout.upper_size
    leaf_begin = lower_begin + lowers * layout.lower_size
    size = leaf_begin + leaves * layout.leaf_size
    return Places((leaves, lowers, len(uppers)), keys, child, gaps, upper_begin, lower_begin, leaf_begin, size)


def write_head(head: GridHead, places: Places, upper_faces: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Write headers, root and root table, still without statistics and checksum.

    Args:
        head: Specification of the grid.
        places: Positions of its nodes.
        upper_faces: For each upper node one bit per face, -x +x -y +y -z +z, that is set if the face lies inside, shape
            (U,).
    """
    buffer = aligned_buffer(places.upper_begin, zeroed=True)
    begins = (places.leaf_begin, places.lower_begin, places.upper_begin, HEAD_SIZE)
    write_header(buffer, head.layout, head.options, places.size, begins, places.counts)
    grid = grid_nodes(buffer, head.layout)
    grid.entry_count[0] = len(places.root_keys)
    table = grid.table
    table["key"] = places.root_keys
    table["value"] = head.background
    to_upper = places.upper_begin - HEAD_SIZE + places.root_child * head.layout.upper_size
    table["child"] = np.where(places.root_child >= 0, to_upper, 0)
    table["value"][gaps_inside(places.gaps, upper_faces)] = head.inside
    return buffer


def write_root(
    buffer: NDArray[np.uint8], head: GridHead, boxes: NDArray[np.int32], extrema: NDArray[Any], active: int
) -> None:
    """Write the grid's statistics from those of its upper nodes: boxes (U, 2, 3) and extrema (U, 2)."""
    grid = grid_nodes(buffer, head.layout)
    box = grid.root.column(("<i4", 3), 0, 2)[0]
    box[0], box[1] = np.iinfo(np.int32).max, np.iinfo(np.int32).min
    some = boxes[:, 0, 0] <= boxes[:, 1, 0]
    grid.background[...] = grid.root.limits[:] = head.background
    if some.any():
        box[0], box[1] = boxes[some, 0].min(axis=0), boxes[some, 1].max(axis=0)
        grid.root.limits[0] = extrema[some, 0].min(), extrema[some, 1].max()
    tree_header(buffer)["voxel_count"] = active
    root_spans(buffer[:TREE_OFFSET].view(GRID_DATA), box[None])


def root_keys_of(voxels: NDArray[Any]) -> NDArray[np.uint64]:
    """Keys of the root entries for voxels (N, 3)."""
    # 20 bits of each coordinate; negative ones wrap around, as in NanoVDB's unsigned shift.
    x, y, z = voxels.T.astype(np.int64) >> 12 & ((1 << ROOT_BITS) - 1)
    return np.asarray((x << 42 | y << 21 | z).astype(np.uint64))


def with_gaps(
    uppers: NDArray[np.uint64], fill_gaps: bool
) -> tuple[NDArray[np.uint64], NDArray[np.int64], list[tuple[int, int, int]]]:
    """The root table, with a tile for every gap between two upper nodes on one line along z."""
    numbers = np.arange(len(uppers))
    if not fill_gaps or len(uppers) < 2:
        return uppers, numbers, []
    line = uppers >> np.uint64(21)
    # Signed z defines the gaps; the order of the keys puts negative z last.
    z = (uppers & np.uint64((1 << 21) - 1)).astype(np.int64)
    z = np.where(z >= 1 << 19, z - (1 << 20), z)
    order = np.lexsort((z, line))
    below, above = order[:-1], order[1:]
    missing = np.where(line[below] == line[above], z[above] - z[below] - 1, 0)
    if missing.sum() > LARGEST_GAP_TILES:
        raise InputError(
            f"leaf_origins: {int(missing.sum())} empty nodes of 4096^3 voxels lie between the leaves, more than "
            f"{LARGEST_GAP_TILES}; use larger voxels or a volume per object"
        )
    pair = np.repeat(np.arange(len(below)), missing)
    step = np.arange(len(pair)) - np.repeat(np.cumsum(missing) - missing, missing)
    tile_z = (z[below][pair] + 1 + step) & ((1 << 20) - 1)
    tiles = line[below][pair] << np.uint64(21) | tile_z.astype(np.uint64)
    keys = np.concatenate([uppers, tiles])
    rank = np.argsort(keys, kind="stable")
    child = np.concatenate([numbers, np.full(len(tiles), -1)])[rank]
    row_of = np.empty(len(keys), np.int64)
    row_of[rank] = np.arange(len(keys))
    rows = row_of[len(uppers) :]
    gaps = list(zip(rows.tolist(), below[pair].tolist(), above[pair].tolist(), strict=True))
    return keys[rank], child, gaps


def gaps_inside(gaps: list[tuple[int, int, int]], faces: NDArray[np.uint8]) -> list[int]:
    """Rows of the gaps that lie inside: both their ends do, faces +z (5) and -z (4) of the nodes below and above."""
    return [row for row, below, above in gaps if faces[below] >> 5 & 1 and faces[above] >> 4 & 1]


@np.errstate(over="ignore", invalid="ignore")  # transforms of damaged files
def root_spans(grids: NDArray[Any], boxes: NDArray[np.int32]) -> None:
    """Write world boxes in headers (N,); an upper corner is the far side of the last voxel, as in NanoVDB.

    Args:
        grids: The headers, of type GRID_DATA.
        boxes: First and last active voxels (N, 2, 3), in reverse order if there are none.
    """
    grids["world_bbox"] = _NO_BOX
    some = np.flatnonzero(boxes[:, 0, 0] <= boxes[:, 1, 0])
    ends = boxes[some].astype(np.float64) + np.array([[0.0], [1.0]])
    corners = ends[:, _CORNERS, np.arange(3)[:, None]]
    world = grids["matrix"][some].reshape(-1, 3, 3) @ corners + grids["vector"][some, :, None]
    grids["world_bbox"][some] = np.concatenate([world.min(axis=2), world.max(axis=2)], axis=1)
    grids["flags"][some] |= FLAG_HAS_BBOX
