"""What stands before the nodes of a grid: headers, root and the root's table, written on the host."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError
from geokit.volume._nanovdb import (
    FLAG_BREADTH_FIRST,
    FLAG_HAS_BBOX,
    FLAG_HAS_MIN_MAX,
    HEAD_SIZE,
    MAGIC_OLD,
    TREE_OFFSET,
    aligned_buffer,
    encoded_name,
    grid_class_code,
    grid_header,
    tree_header,
    voxel_size_of,
)
from geokit.volume._nanovdb_layout import GRID_TYPES, GridLayout, layout_of

__all__ = ["GridHead", "Places", "checked_head", "places_of", "write_head", "write_root"]

# 32.4.2 is what OpenVDB 10 writes; later readers take it too.
VERSION = 32 << 21 | 4 << 10 | 2
LONGEST_NAME = 255
# Tiles between upper nodes are written one by one: this many are 2 MiB and cover 2.7e8 voxels of solid along an axis.
LARGEST_GAP_TILES = 1 << 16
_WORDS = {"float": "<f4", "int32": "<i4"}


@dataclass(frozen=True)
class GridHead:
    """What a grid is to be, apart from its voxels: type, background, inside value, transform, name and class."""

    layout: GridLayout
    background: float
    inside: float
    transform: NDArray[np.float64]
    name: bytes
    grid_class: int

    @property
    def word(self) -> np.dtype[Any]:
        """NumPy type of a value."""
        return np.dtype(_WORDS[self.layout.name])


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
    encoded = encoded_name(name)
    if len(encoded) > LONGEST_NAME or b"\0" in encoded:
        raise InputError(f"name: {len(encoded)} bytes; use at most {LONGEST_NAME} without a zero byte")
    matrix = _checked_transform(transform)
    if not (np.isfinite(background) and np.isfinite(inside)):
        raise InputError(f"background: {background} is not finite; give a number")
    code = grid_class_code(grid_class)
    if code == 0 and grid_class != "unknown":
        raise InputError(f"grid_class: NanoVDB has no class {grid_class!r}; use 'level set', 'fog volume' or 'unknown'")
    layout = layout_of(GRID_TYPES.index(grid_type), "grid")
    return GridHead(layout, background, inside, matrix, encoded, code)


def _checked_transform(transform: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.array(transform, np.float64)
    if matrix.shape != (4, 4):
        raise InputError(f"transform: shape {matrix.shape} is not (4, 4); give index to world")
    linear = matrix[:3, :3]
    scale = np.abs(linear).max(axis=1, keepdims=True)
    if (
        not np.isfinite(matrix).all()
        or not (scale > 0.0).all()
        or np.linalg.matrix_rank(linear / scale) < 3
        or (matrix[3] != (0.0, 0.0, 0.0, 1.0)).any()
    ):
        raise InputError(
            "transform: not a finite, invertible affine map with the last row 0 0 0 1; give index to world"
        )
    return matrix


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
    keys, child, gaps = _with_gaps(_root_key(uppers), fill_gaps)
    upper_begin = HEAD_SIZE + layout.root_size + len(keys) * layout.root_tile_size
    lower_begin = upper_begin + len(uppers) * layout.upper_size
    leaf_begin = lower_begin + lowers * layout.lower_size
    size = leaf_begin + leaves * layout.leaf_size
    return Places((leaves, lowers, len(uppers)), keys, child, gaps, upper_begin, lower_begin, leaf_begin, size)


def _root_key(uppers: NDArray[np.int64]) -> NDArray[np.uint64]:
    # 20 bits of each coordinate, negative ones wrapped as NanoVDB does by shifting unsigned.
    x, y, z = uppers.T & ((1 << 20) - 1)
    return np.asarray((x << 42 | y << 21 | z).astype(np.uint64))


def _with_gaps(
    uppers: NDArray[np.uint64], fill_gaps: bool
) -> tuple[NDArray[np.uint64], NDArray[np.int64], list[tuple[int, int, int]]]:
    """The root's table, with a tile for every place between two upper nodes on one line along z."""
    numbers = np.arange(len(uppers))
    if not fill_gaps or len(uppers) < 2:
        return uppers, numbers, []
    line = uppers >> np.uint64(21)
    # Signed z decides what lies between: the keys' own order puts negative ones last.
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


def write_head(head: GridHead, places: Places, upper_faces: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Headers, root and the root's table, still without statistics and checksum.

    Args:
        head: What the grid is to be.
        places: Where its nodes are.
        upper_faces: For each upper node a bit for each face, -x +x -y +y -z +z: whether it lies inside, shape (U,).
    """
    buffer = aligned_buffer(places.upper_begin, zeroed=True)
    linear = head.transform[:3, :3]
    inverse = np.linalg.inv(linear)
    grid = grid_header(buffer)
    grid["magic"], grid["version"] = MAGIC_OLD, VERSION
    grid["flags"] = FLAG_BREADTH_FIRST | FLAG_HAS_MIN_MAX
    grid["grid_count"] = 1
    grid["grid_size"] = grid["blind_offset"] = places.size
    grid["name"] = head.name
    translation = head.transform[:3, 3]
    grid["matrix"], grid["inverse"], grid["vector"], grid["taper"] = linear.ravel(), inverse.ravel(), translation, 1.0
    # Beyond float32's range the single-precision map overflows to inf; geokit's kernels use the double one.
    with np.errstate(over="ignore", under="ignore"):
        grid["matrix_f"], grid["inverse_f"] = linear.ravel(), inverse.ravel()
        grid["vector_f"], grid["taper_f"] = translation, 1.0
    grid["voxel_size"] = voxel_size_of(head.transform)
    grid["grid_class"], grid["grid_type"] = head.grid_class, GRID_TYPES.index(head.layout.name)
    tree = tree_header(buffer)
    begins = (places.leaf_begin, places.lower_begin, places.upper_begin, HEAD_SIZE)
    tree["node_offset"] = [begin - TREE_OFFSET for begin in begins]
    tree["node_count"] = places.counts
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
    _write_world_box(buffer, box if some.any() else None)


def _write_world_box(buffer: NDArray[np.uint8], box: NDArray[np.int32] | None) -> None:
    # The upper corner is the far side of the last voxel, as NanoVDB has it.
    grid = grid_header(buffer)
    if box is None:
        limits = np.finfo(np.float64)
        grid["world_bbox"] = [limits.max] * 3 + [limits.min] * 3
        return
    ends = np.stack([box[0].astype(np.float64), box[1].astype(np.float64) + 1.0])
    corners = np.array(np.meshgrid(*ends.T, indexing="ij")).reshape(3, -1)
    world = grid["matrix"].reshape(3, 3) @ corners + grid["vector"][:, None]
    grid["world_bbox"] = np.concatenate([world.min(axis=1), world.max(axis=1)])
    grid["flags"] |= FLAG_HAS_BBOX
