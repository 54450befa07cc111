"""Finds the tiles of free space in which the sign of an open mesh changes.

In the hole of an open mesh the winding number passes 1/2 away from the surface. The tiles that this sign change crosses
become leaves without active voxels. Then leaves hold every sign change, as those of a closed mesh do, and each slot
without a child lies on one side.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.late_warp import wp
from geokit.volume.band.place_keys import keys_of, places_of
from geokit.volume.band.tiles import LEAF_BYTES, MOST_TILES, TILE_VOXELS, WORKING_BYTES, Lattice, Tiles, in_grid_order

# Tiles that are tested at a time: 43 MB of points.
TILES_AT_A_TIME = 1 << 15
# The six neighbors of a tile.
BESIDE = np.concatenate([np.eye(3, dtype=np.int64), -np.eye(3, dtype=np.int64)])
# Voxels that are tested for each tile: three by three on each plane of voxels next to it. Those planes are part of the
# test because the sign may change exactly between two tiles.
PROBES = np.array([
    np.insert(place, axis, side)
    for axis in range(3)
    for side in (-1, TILE_VOXELS)
    for place in product((0, 4, 7), repeat=2)
])  # fmt: skip


def with_sign_changes(lattice: Lattice, tiles: Tiles, method: str) -> Tiles:
    """The tiles near the surface, and all tiles that are joined to them by the sign change.

    The sign change is followed from tile to tile. It begins near the surface: the winding number is harmonic elsewhere,
    so that no region of one sign lies in free space alone.

    Raises:
        DeviceMemoryError: The tiles need more memory than there is.
    """
    near = tiles.coordinates.numpy().astype(np.int64)
    origin = _box(lattice, method)[0] - 2
    # A band has fewer than 2^21 tiles along an axis.
    seen, tested = np.sort(keys_of(near - origin)), np.zeros(0, np.int64)
    front, found = near, [near]
    while len(front):
        beside = np.unique(keys_of((front[:, None] + BESIDE - origin).reshape(-1, 3)))
        for before in (seen, tested):
            beside = beside[~np.isin(beside, before, assume_unique=True)]
        tested = np.union1d(tested, beside)
        front = places_of(beside) + origin
        front = front[_changes_sign(lattice, front, method)]
        found.append(front)
        lattice.require_memory(sum(map(len, found)) * float(LEAF_BYTES + WORKING_BYTES))
    together = np.concatenate(found)
    if len(together) == len(near):
        return tiles
    count, device = len(together), lattice.device
    cells = wp.array(together.astype(np.int32), dtype=wp.vec3i, device=device)
    ends = wp.array(np.arange(1, count + 1), dtype=wp.int32, device=device)
    return in_grid_order(cells, ends, ends, count, together.min(axis=0), together.max(axis=0))


def keep_sign_changes(lattice: Lattice, places: NDArray[np.int32], method: str, kept: "wp.array") -> None:
    """Set ``kept`` (L,) for the tiles in which the sign changes, at ``places`` (L, 3)."""
    flags = kept.numpy()
    others = np.flatnonzero(flags == 0)
    flags[others] = _changes_sign(lattice, places[others].astype(np.int64), method)
    kept.assign(flags)


def beyond_signs(lattice: Lattice, places: NDArray[Any], method: str) -> NDArray[np.bool_]:
    """Whether tiles (L, 3) lie outside of the box in which signs are those of the mesh; there all is outside."""
    low, high = _box(lattice, method)
    return np.asarray(((places < low) | (places > high)).any(axis=1))


def _changes_sign(lattice: Lattice, places: NDArray[np.int64], method: str) -> NDArray[np.bool_]:
    """Whether a tile or the voxels next to it lie on both sides; the surface must not cross them."""
    answer = np.zeros(len(places), bool)
    for start in range(0, len(places), TILES_AT_A_TIME):
        part = places[start : start + TILES_AT_A_TIME]
        voxels = (TILE_VOXELS * part[:, None] + PROBES).reshape(-1, 3)
        inside = np.asarray(
            lattice.surface.contains(voxels * lattice.voxel_size + lattice.translation, sign=method)
        ) & ~beyond_signs(lattice, voxels // TILE_VOXELS, method)
        share = inside.reshape(len(part), -1).mean(axis=1)
        answer[start : start + len(part)] = (share > 0.0) & (share < 1.0)
    return answer


def _box(lattice: Lattice, method: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last tile of the box in which signs are those of the mesh.

    By winding number a region inside extends beyond the mesh where open sheets lie on top of each other; the box is the
    band's, and its longest edge more on each side. By the other methods such a region may have no end.
    """
    low, high = (end.astype(np.int64) for end in lattice.box(lattice.voxel_size))
    longest = int((high - low).max()) + 1
    more = 1 if method != "winding" else max(1, min(longest, (MOST_TILES - longest) // 2))
    return low - more, high + more
