"""Dilates and erodes the active voxels of a grid by whole voxels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.require import require_choice
from geokit.volume.level_set.leaf_neighbors import LinkedLeaves
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.nodes import bits_of
from geokit.volume.tree.estimates import FARTHEST_TILE
from geokit.volume.tree.leaves import LEAF_VOXELS, Leaves, dequantized, require_volume
from geokit.volume.tree.typed_tree import VALUE_TYPES, TypedTree, differs, tree_of, voxelized_tree
from geokit.volume.tree.typed_writer import rebuilt

NEIGHBORS = ("faces", "edges", "vertices")
# Voxels of dilation before leaves are added: it must not reach beyond the adjacent leaves.
STAGE = 8
# Most voxels per call; beyond this a grid should have larger voxels.
MOST_VOXELS = 1024
# Fewest planes per thread.
GRAIN = 64


def changed_topology(volume: SparseVolume, steps: tuple[int, ...], neighbors: str, device: Any) -> SparseVolume:
    """The volume after dilations (positive steps) and erosions (negative steps) of its active voxels, in turn.

    Voxels that become active keep their value. Voxels that become inactive get the background.

    Args:
        volume: A grid of any type that holds values.
        steps: Voxels of each dilation (positive) or erosion (negative).
        neighbors: "faces", "edges" or "vertices".
        device: Where to compute; None for the first GPU, else the CPU.
    Raises:
        InputError: ``neighbors`` is unknown, or a step has too many voxels.
        UnsupportedGridError: The grid holds no values of its own.
        DeviceMemoryError: The result needs more memory than there is.
    """
    require_volume(volume, "volume", VALUE_TYPES)
    require_choice(neighbors, "neighbors", NEIGHBORS)
    source = dequantized(volume)
    target = launcher.resolve_device(device)
    source.on(target)  # checks the grid before its contents are used
    tree = voxelized_tree(tree_of(source), volume.info.name)
    leaves = LinkedLeaves.bare(source, Leaves(tree.origins, tree.masks), target)
    words = leaves.active
    for step in steps:
        words = _grown(leaves, words, step, neighbors) if step > 0 else _stepped(leaves, words, -step, neighbors, True)
    masks = words.numpy().view(np.uint8).reshape(-1, LEAF_VOXELS // 8)
    return rebuilt(_with_masks(tree, 8 * leaves.tiles, masks), source)


def _with_masks(tree: TypedTree, origins: NDArray[np.int32], masks: NDArray[np.uint8]) -> TypedTree:
    """The tree with other active voxels. Its own leaves come first; added leaves have the values of its tiles.

    Voxels that become inactive get the background; voxels that stay inactive keep their value.
    """
    count = len(tree.origins)
    values = np.empty((len(origins), *tree.values.shape[1:]), tree.values.dtype)
    values[:count] = tree.values
    values[count:] = tree.tiles_at(origins[count:])[0][:, None]
    off = tree.masks & ~masks[:count]
    rows = np.flatnonzero(off.any(axis=1))
    part = values[rows]
    part[bits_of(off[rows])] = tree.background
    values[rows] = part
    # Added leaves without an active voxel equal the tiles in their place, so they are dropped. Leaves of the tree
    # without an active voxel are dropped if all their values are background.
    kept = np.asarray(masks.any(axis=1))
    empty = np.flatnonzero(~kept[:count])
    if tree.layout.name != "mask":
        kept[empty] = differs(values[empty], tree.background).any(axis=1)
    return replace(tree, origins=origins[kept], masks=masks[kept], values=values[kept])


def _grown(leaves: LinkedLeaves, words: "wp.array", count: int, neighbors: str) -> "wp.array":
    while count > 0:
        stage = min(STAGE, count)
        count -= stage
        tiles = leaves.within(words, stage)
        # Voxel indices must fit into int32.
        leaves.add(tiles[((tiles >= -FARTHEST_TILE) & (tiles < FARTHEST_TILE)).all(axis=1)])
        words = _stepped(leaves, leaves.extended(words, 8, 0), stage, neighbors, False)
    return words


def _stepped(leaves: LinkedLeaves, words: "wp.array", count: int, neighbors: str, shrink: bool) -> "wp.array":
    from geokit.volume.level_set import mask_dilation_kernels as kernels

    kernel = getattr(kernels, f"grow_{neighbors}_kernel")
    flip = wp.uint64((1 << 64) - 1 if shrink else 0)
    for _ in range(count):
        following = wp.empty_like(words)
        launcher.launch(kernel, len(words), [words, flip, leaves.beside], [following], leaves.device, grain=GRAIN)
        words = following
    return words
