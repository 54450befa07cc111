"""Growing and shrinking the active voxels of a grid, whole voxels at a time."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.errors import InputError
from geokit.volume._model import SparseVolume
from geokit.volume.level_set.leaf_neighbors import AROUND, LinkedLeaves
from geokit.volume.tree.leaves import LEAF_VOXELS, Leaves, dequantized, require_volume
from geokit.volume.tree.typed_tree import VALUE_TYPES, TypedTree, bits_of, differs, tree_of, voxelized_tree
from geokit.volume.tree.typed_writer import rebuilt

if TYPE_CHECKING:
    import warp as wp

__all__ = ["NEIGHBORS", "changed_topology"]

NEIGHBORS = ("faces", "edges", "vertices")
# Voxels that leaves grow by before room for more is made: no farther than the leaves beside them.
STAGE = 8
# Most voxels at a time: beyond this a grid should have larger voxels.
MOST_VOXELS = 1024
# Leaves from the origin on along an axis.
FARTHEST_TILE = 1 << 28
# Fewest planes worth a thread.
GRAIN = 64


def changed_topology(volume: SparseVolume, steps: tuple[int, ...], neighbors: str, device: Any) -> SparseVolume:
    """The volume after growing by positive, and shrinking by negative numbers of voxels, one after the other.

    Voxels that become active keep the value that they had, those that become inactive get the background.

    Raises:
        InputError: Unknown neighbours, or voxels too many.
        UnsupportedGridError: A grid that holds no values of its own.
        DeviceMemoryError: The result needs more memory than there is.
    """
    require_volume(volume, "volume", VALUE_TYPES)
    if neighbors not in NEIGHBORS:
        raise InputError(f"neighbors: {neighbors!r} is not one of {', '.join(NEIGHBORS)}")
    source = dequantized(volume)
    target = launcher.resolve_device(device)
    source.on(target)  # looks at the grid before anything of it is believed
    tree = voxelized_tree(tree_of(source), volume.info.name)
    leaves = LinkedLeaves.bare(source, Leaves(tree.origins, tree.masks), target)
    words = leaves.active
    for step in steps:
        words = _grown(leaves, words, step, neighbors) if step > 0 else _stepped(leaves, words, -step, neighbors, True)
    masks = words.numpy().view(np.uint8).reshape(-1, LEAF_VOXELS // 8)
    return rebuilt(_with_masks(tree, 8 * leaves.tiles, masks), source)


def _with_masks(tree: TypedTree, origins: NDArray[np.int32], masks: NDArray[np.uint8]) -> TypedTree:
    """The tree with other active voxels; its own leaves come first, those added have the values of its tiles.

    What is turned off becomes background; what was inactive and stays so is as it was.
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
    # Added leaves without an active voxel are the tiles in whose place they are; others go where all is background.
    kept = np.asarray(masks.any(axis=1))
    empty = np.flatnonzero(~kept[:count])
    if tree.layout.name != "mask":
        kept[empty] = differs(values[empty], tree.background).any(axis=1)
    return replace(tree, origins=origins[kept], masks=masks[kept], values=values[kept])


def _grown(leaves: LinkedLeaves, words: "wp.array", count: int, neighbors: str) -> "wp.array":
    import warp as wp

    from geokit.volume.level_set.feature_transform_kernels import reached_box_kernel

    while count > 0:
        stage = min(STAGE, count)
        count -= stage
        boxes = wp.empty((len(leaves.tiles), 6), dtype=wp.int32, device=leaves.device)
        launcher.launch(reached_box_kernel, len(leaves.tiles), [words], [boxes], leaves.device, grain=GRAIN)
        box = boxes.numpy().reshape(-1, 2, 3)
        wanted = np.repeat(box[:, 1, :1] >= 0, len(AROUND), axis=1)
        for axis in range(3):
            wanted &= (AROUND[:, axis] >= 0) | (box[:, 0, axis, None] < stage)
            wanted &= (AROUND[:, axis] <= 0) | (box[:, 1, axis, None] + stage > 7)
        tiles = leaves.around(*np.nonzero(wanted))
        # Indices end with int32.
        leaves.add(tiles[((tiles >= -FARTHEST_TILE) & (tiles < FARTHEST_TILE)).all(axis=1)])
        words = _stepped(leaves, leaves.extended(words, 8, 0), stage, neighbors, False)
    return words


def _stepped(leaves: LinkedLeaves, words: "wp.array", count: int, neighbors: str, shrink: bool) -> "wp.array":
    import warp as wp

    from geokit.volume.level_set import mask_dilation_kernels as kernels

    kernel = getattr(kernels, f"grow_{neighbors}_kernel")
    flip = wp.uint64((1 << 64) - 1 if shrink else 0)
    for _ in range(count):
        following = wp.empty_like(words)
        launcher.launch(kernel, len(words), [words, flip, leaves.beside], [following], leaves.device, grain=GRAIN)
        words = following
    return words
