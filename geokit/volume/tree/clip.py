"""Clipping of grids of any value type: tiles that the box's faces cut are split, level by level."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory import available_memory
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.layout import LEAF_VOXELS
from geokit.volume.nanovdb.nodes import bits_of
from geokit.volume.tree.typed_tree import Nodes, TypedTree, differs, tree_of
from geokit.volume.tree.typed_writer import rebuilt

LEAVES_AT_A_TIME = 4096
# First and last of eight positions along each axis.
CORNERS = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1)


def clipped(volume: SparseVolume, box: NDArray[np.float64]) -> SparseVolume:
    """Keep the voxels whose centers lie in a box (2, 3) [world], for one of VALUE_TYPES; all others become background.

    Raises:
        DeviceMemoryError: The box cuts larger tiles than fit into memory.
    """
    tree = tree_of(volume)
    transform = volume.info.transform
    kind = tree.layout.background
    side = _side_of(tree.root.origins, 4096, transform, box)
    upper = [_masked(tree.upper, 32, 128, transform, box, tree.background)]
    # Cut tiles pass to the next level as nodes filled with their value.
    upper.append(_split(tree.root.rows(side == 0), 32, 128, transform, box, tree.background))
    lower = [_masked(tree.lower, 16, 8, transform, box, tree.background)]
    for nodes in upper:
        _require_memory(volume, int(nodes.cut.sum()) * 4096 * (kind.itemsize + 1))
        lower.append(_split(nodes.cut_tiles(32, 128), 16, 8, transform, box, tree.background))
    origins, masks, values = [tree.origins], [tree.masks], [tree.values]
    _require_memory(volume, sum(int(nodes.cut.sum()) for nodes in lower) * (3 * LEAF_VOXELS * kind.itemsize + 100))
    for nodes in lower:
        tiles = nodes.cut_tiles(16, 8)
        origins.append(tiles.origins)
        masks.append(np.where(tiles.active[:, None], np.uint8(255), np.uint8(0)).repeat(LEAF_VOXELS // 8, axis=1))
        values.append(np.broadcast_to(tiles.values[:, None], (len(tiles.values), LEAF_VOXELS, *kind.shape)))
    result = replace(
        tree,
        origins=_all_of(origins),
        masks=_all_of(masks),
        values=_all_of(values),
        lower=_joined(lower, tree.background),
        upper=_joined(upper, tree.background),
        root=tree.root.rows(side > 0),
    )
    return rebuilt(_leaves_inside(result, transform, box), volume)


def _all_of(parts: list[NDArray[Any]]) -> NDArray[Any]:
    """Concatenate parts of an array; without a copy if only the first is not empty."""
    return np.concatenate(parts) if any(map(len, parts[1:])) else parts[0]


class _Cut(NamedTuple):
    """Nodes, and a mask (N, slots) of the slots that the box's faces cut."""

    nodes: Nodes
    cut: NDArray[np.bool_]

    def cut_tiles(self, width: int, span: int) -> Nodes:
        """The tiles in the slots that are cut."""
        nodes, cut = self
        return Nodes(nodes.corners(cut, width, span), nodes.values[cut], nodes.active[cut])


def _masked(
    nodes: Nodes, width: int, span: int, transform: NDArray[Any], box: NDArray[Any], background: NDArray[Any]
) -> _Cut:
    """Nodes with background in place of the tiles outside the box."""
    if not len(nodes.origins):
        return _Cut(nodes, np.zeros_like(nodes.active))
    values, active = nodes.values.copy(), nodes.active.copy()
    told = active | differs(values, background)
    side = np.ones(told.shape, np.int8)
    side[told] = _side_of(nodes.corners(told, width, span), span, transform, box)
    outside = side < 0
    values[outside], active[outside] = background, False
    return _Cut(Nodes(nodes.origins, values, active), side == 0)


def _split(
    tiles: Nodes, width: int, span: int, transform: NDArray[Any], box: NDArray[Any], background: NDArray[Any]
) -> _Cut:
    """Nodes filled with the values of some tiles."""
    shape = (len(tiles.origins), width**3)
    values = np.broadcast_to(tiles.values[:, None], (*shape, *background.shape))
    full = Nodes(tiles.origins, values, np.broadcast_to(tiles.active[:, None], shape))
    return _masked(full, width, span, transform, box, background)


def _joined(parts: list[_Cut], background: NDArray[Any]) -> Nodes:
    """All nodes of a level, with background in place of the tiles that passed to the next level."""
    found = []
    for nodes, cut in parts:
        if not len(nodes.origins):
            continue
        nodes.values[cut], nodes.active[cut] = background, False
        some = (nodes.active | differs(nodes.values, background)).any(axis=1)
        found.append(nodes.rows(some))
    return Nodes.joined(found) if found else parts[0].nodes


def _side_of(
    corners: NDArray[np.int32], span: int, transform: NDArray[np.float64], box: NDArray[np.float64]
) -> NDArray[np.int8]:
    """Classify cubes of voxels: 1 if all centers are in the box, -1 if none can be, else 0.

    Rounded sums and products are monotonic too. So a result for the corners, computed as for single voxels, holds for
    all voxels between them.
    """
    voxels = np.moveaxis(corners[:, None].astype(np.float64) + CORNERS * (span - 1), -1, 0)
    worlds = [m[0] * voxels[0] + m[1] * voxels[1] + m[2] * voxels[2] + m[3] for m in transform[:3]]
    inside = np.ones(len(corners), np.bool_)
    outside = np.zeros(len(corners), np.bool_)
    for world, low, high in zip(worlds, *box, strict=True):
        inside &= ((world >= low) & (world <= high)).all(axis=1)
        outside |= (world < low).all(axis=1) | (world > high).all(axis=1)
    return np.where(inside, 1, np.where(outside, -1, 0)).astype(np.int8)


def _leaves_inside(tree: TypedTree, transform: NDArray[np.float64], box: NDArray[np.float64]) -> TypedTree:
    side = _side_of(tree.origins, 8, transform, box)
    kept = side > 0
    cut = np.flatnonzero(side == 0)
    changed = []
    for first in range(0, len(cut), LEAVES_AT_A_TIME):
        rows = cut[first : first + LEAVES_AT_A_TIME]
        inside = _voxels_inside(tree.origins[rows], transform, box)
        states = bits_of(tree.masks[rows]) & inside
        values = tree.values[rows]
        values[~inside] = tree.background
        some = states.any(axis=1)
        if tree.layout.name != "mask":
            some |= differs(values, tree.background).any(axis=1)
        kept[rows] = some
        changed.append((rows[some], np.packbits(states[some], axis=1, bitorder="little"), values[some]))
    # If all leaves remain, they are copied once.
    taken = np.flatnonzero(kept)
    masks, values = tree.masks[taken], tree.values[taken]
    for rows, new_masks, new_values in changed:
        at = np.searchsorted(taken, rows)
        masks[at], values[at] = new_masks, new_values
    return replace(tree, origins=tree.origins[taken], masks=masks, values=values)


def _voxels_inside(
    origins: NDArray[np.int32], transform: NDArray[np.float64], box: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Mask of the voxels (L, 512) of leaves whose centers are in the box."""
    inside = np.ones((len(origins), 8, 8, 8), np.bool_)
    steps = np.arange(8)
    voxels = [
        (origins[:, axis, None].astype(np.int64) + steps).astype(np.float64).reshape(-1, *np.roll((8, 1, 1), axis))
        for axis in range(3)
    ]
    for m, low, high in zip(transform[:3], *box, strict=True):
        used = np.flatnonzero(m[:3])
        # Along a single axis the world coordinate is the same number: the omitted terms are zero.
        terms = [m[axis] * voxels[axis] for axis in (used if len(used) == 1 else range(3))]
        world = sum(terms[1:], terms[0]) + m[3]
        inside &= (world >= low) & (world <= high)
    return inside.reshape(-1, LEAF_VOXELS)


def _require_memory(volume: SparseVolume, need: int) -> None:
    what = f"volume: the tiles of grid {volume.info.name!r} that the box cuts through need"
    available_memory.require_room(need, what, "use a smaller box")
