"""The root table of a grid: keys of its entries and tiles between upper nodes; the grid's world box."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError
from geokit.volume.nanovdb.header import FLAG_HAS_BBOX

__all__ = ["gaps_inside", "root_keys_of", "root_spans", "with_gaps"]

# Largest number of tiles between upper nodes: they are 2 MiB and cover 2.7e8 voxels of solid along an axis.
LARGEST_GAP_TILES = 1 << 16
# Bits of a coordinate in the key of a root entry.
ROOT_BITS = 20
# For each corner of a box, which end it has along each axis; the box of nothing.
_CORNERS = np.indices((2, 2, 2)).reshape(3, -1)
_NO_BOX = np.repeat([np.finfo(np.float64).max, np.finfo(np.float64).min], 3)


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
