"""Pruning grids of any value type: nodes whose voxels are alike become tiles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory.needs import needs
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.header import grid_header
from geokit.volume.nanovdb.layout import GridLayout, layout_of
from geokit.volume.nanovdb.nodes import GridNodes, grid_nodes, slot_of
from geokit.volume.tree.estimates import leaf_count
from geokit.volume.tree.typed_tree import Nodes, TypedTree, differs, tree_of
from geokit.volume.tree.typed_writer import rebuilt

ROWS_AT_A_TIME = 4096
# Every so many values of a node are compared first: eight of a leaf, in different rows and columns.
SAMPLE_STEP = 73
# A word of 64 active voxels.
ALL = np.uint64(0xFFFFFFFFFFFFFFFF)


def pruned(volume: SparseVolume, tolerance: float) -> SparseVolume:
    """Replace nodes with one state and values within a tolerance by tiles, in a volume of one of VALUE_TYPES.

    Where there are none it is the volume itself.
    """
    check_volume(volume)
    buffer = volume.nanovdb
    layout = layout_of(int(grid_header(buffer)["grid_type"]), f"volume {volume.info.name!r}")
    grid = grid_nodes(buffer, layout)
    # The two values of a bool are alike only if they are equal.
    tolerance = 0.0 if layout.leaf_bits == 1 else tolerance
    words = grid.leaf.value_mask.view("<u8")
    full, empty = (words == ALL).all(axis=1), ~words.any(axis=1)
    alike = full | empty
    # A mask has states only.
    if layout.leaf_bits > 1:
        alike[alike] = _alike(grid.leaf.values, np.flatnonzero(alike), tolerance)
    if not alike.any() and _has_leaves_only(grid):
        return volume
    return _with_tiles(volume, layout, alike, full, tolerance)


@needs(lambda volume, *_: 4400 * leaf_count(volume), name="prune")
def _with_tiles(
    volume: SparseVolume, layout: GridLayout, alike: NDArray[np.bool_], full: NDArray[np.bool_], tolerance: float
) -> SparseVolume:
    """The volume with tiles for the leaves that are alike; those of them that are full are active."""
    tree = tree_of(volume)
    if layout.name == "bool":
        alike[alike] = _alike(tree.values, np.flatnonzero(alike), tolerance)
    tiles = Nodes(tree.origins[alike], _middle(tree.values, np.flatnonzero(alike), tolerance), full[alike])
    tree = replace(tree, origins=tree.origins[~alike], masks=tree.masks[~alike], values=tree.values[~alike])
    lower, tiles = _level(tree, tree.lower, tiles, tree.origins, 16, 8, tolerance)
    tree = replace(tree, lower=lower)
    upper, tiles = _level(tree, tree.upper, tiles, np.concatenate([tree.origins, lower.origins]), 32, 128, tolerance)
    root = Nodes.joined([tree.root, tiles])
    told = root.active | differs(root.values, tree.background)
    return rebuilt(replace(tree, upper=upper, root=root.rows(told)), volume)


def _has_leaves_only(grid: GridNodes) -> bool:
    """Whether no node of the grid but a leaf can become a tile: each of them has a child."""
    nodes = grid.lower, grid.upper
    return bool((grid.table["child"] != 0).all() and all(level.child_mask.any(axis=1).all() for level in nodes))


def _level(
    tree: TypedTree, nodes: Nodes, tiles: Nodes, below: NDArray[np.int32], width: int, span: int, tolerance: float
) -> tuple[Nodes, Nodes]:
    """Put tiles into the nodes of a level; returns the nodes that remain, and those that have become tiles themselves.

    Args:
        tree: The tree.
        nodes: Nodes of the level before pruning.
        tiles: New tiles of ``span``^3 voxels.
        below: Any voxel of each child that remains below the level.
        width: Slots along an axis.
        span: Voxels of a slot along an axis.
        tolerance: Largest difference of values in a tile.
    """
    told = tiles.active | differs(tiles.values, tree.background)
    tiles = tiles.rows(told)
    corner = ~np.int32(width * span - 1)
    origins, row = np.unique(np.concatenate([nodes.origins, tiles.origins & corner]), axis=0, return_inverse=True)
    row = row.reshape(-1)
    count = len(nodes.origins)
    shape = tree.layout.background.shape
    values = np.empty((len(origins), width**3, *shape), tree.layout.background.base)
    values[:] = tree.background
    active = np.zeros(values.shape[:2], np.bool_)
    values[row[:count]], active[row[:count]] = nodes.values, nodes.active
    slot = slot_of(tiles.origins, width, span)
    values[row[count:], slot], active[row[count:], slot] = tiles.values, tiles.active
    occupied, number = np.unique(np.concatenate([origins, below & corner]), axis=0, return_inverse=True)
    holds = np.zeros(len(occupied), np.bool_)
    holds[number.reshape(-1)[len(origins) :]] = True
    alike = ~holds[number.reshape(-1)[: len(origins)]]
    alike &= active.all(axis=1) | ~active.any(axis=1)
    alike[alike] = _alike(values, np.flatnonzero(alike), tolerance)
    return (
        Nodes(origins[~alike], values[~alike], active[~alike]),
        Nodes(origins[alike], _middle(values, np.flatnonzero(alike), tolerance), active[alike, 0]),
    )


def _alike(values: NDArray[Any], rows: NDArray[np.int64], tolerance: float) -> NDArray[np.bool_]:
    """Mask of the rows (R, n, ...) whose values differ by at most the tolerance in each component."""

    def within(part: NDArray[Any]) -> NDArray[np.bool_]:
        low, high = part.min(axis=1).astype(np.float64), part.max(axis=1).astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            near = high - low <= tolerance
        return np.asarray(near.all(axis=-1) if near.ndim > 1 else near)

    # Most rows differ by more in a few of their values.
    found = within(values[:, ::SAMPLE_STEP][rows])
    left = np.flatnonzero(found)
    for first in range(0, len(left), ROWS_AT_A_TIME):
        some = left[first : first + ROWS_AT_A_TIME]
        found[some] = within(values[rows[some]])
    return found


def _middle(values: NDArray[Any], rows: NDArray[np.int64], tolerance: float) -> NDArray[Any]:
    """The median of each row (R, n, ...); for vectors the middle one in lexicographic order."""
    if tolerance == 0.0:
        return np.asarray(values[rows, 0])
    found = np.empty((len(rows), *values.shape[2:]), values.dtype)
    middle = (values.shape[1] - 1) >> 1
    for first in range(0, len(rows), ROWS_AT_A_TIME):
        part = values[rows[first : first + ROWS_AT_A_TIME]]
        if part.ndim == 2:
            found[first : first + len(part)] = np.partition(part, middle, axis=1)[:, middle]
        else:
            order = np.lexsort(np.moveaxis(part, -1, 0)[::-1], axis=-1)[:, middle]
            found[first : first + len(part)] = part[np.arange(len(part)), order]
    return found
