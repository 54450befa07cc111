"""Growing and shrinking the active voxels of a grid, whole voxels at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit import _launch
from geokit.errors import InputError
from geokit.volume._leaf_links import AROUND, LinkedLeaves
from geokit.volume._leaves import LEAF_VOXELS, Leaves, assemble, require_volume, voxelized
from geokit.volume._nanovdb import TREE_OFFSET, tree_header
from geokit.volume._nanovdb_layout import LAYOUTS
from geokit.volume.model import SparseVolume

if TYPE_CHECKING:
    import warp as wp

__all__ = ["NEIGHBORS", "TYPES", "changed_topology"]

TYPES = ("float", "double", "vec3f", "vec3d")
NEIGHBORS = ("faces", "edges", "vertices")
# Voxels that leaves grow by before room for more is made: no farther than the leaves beside them.
STAGE = 8
# Most voxels at a time: beyond this a grid should have larger voxels.
MOST_VOXELS = 1024
# Fewest planes worth a thread.
GRAIN = 64


def changed_topology(volume: SparseVolume, steps: tuple[int, ...], neighbors: str, device: Any) -> SparseVolume:
    """The volume after growing by positive, and shrinking by negative numbers of voxels, one after the other.

    Voxels that become active keep the value that they had, those that become inactive get the background.

    Raises:
        InputError: Unknown neighbours, or voxels too many.
        UnsupportedGridError: Values of another type than TYPES.
        DeviceMemoryError: The result needs more memory than there is.
    """
    require_volume(volume, "volume", TYPES)
    if neighbors not in NEIGHBORS:
        raise InputError(f"neighbors: {neighbors!r} is not one of {', '.join(NEIGHBORS)}")
    source = voxelized(volume)
    leaves = LinkedLeaves.bare(source, _launch.resolve_device(device))
    words = leaves.active
    for step in steps:
        words = _grown(leaves, words, step, neighbors) if step > 0 else _stepped(leaves, words, -step, neighbors, True)
    masks = words.numpy().view(np.uint8).reshape(-1, LEAF_VOXELS // 8)
    kept = np.flatnonzero(masks.any(axis=1))
    background = np.asarray(source.info.background)
    held = _values(source)
    values = np.empty((len(kept), *held.shape[1:]), held.dtype)
    values[:] = background
    old = kept < len(held)
    values[old] = held[kept[old]]
    values[np.unpackbits(masks[kept], axis=1, bitorder="little") == 0] = background
    return assemble(
        Leaves(8 * leaves.tiles[kept], masks[kept]),
        values,
        volume,
        background=source.info.background,
        grid_class=volume.info.grid_class,
    )


def _grown(leaves: LinkedLeaves, words: "wp.array", count: int, neighbors: str) -> "wp.array":
    import warp as wp

    from geokit.volume._nearest_feature_kernels import reached_box_kernel

    while count > 0:
        stage = min(STAGE, count)
        count -= stage
        boxes = wp.empty((len(leaves.tiles), 6), dtype=wp.int32, device=leaves.device)
        _launch.launch(reached_box_kernel, len(leaves.tiles), [words], [boxes], leaves.device, grain=GRAIN)
        box = boxes.numpy().reshape(-1, 2, 3)
        wanted = np.repeat(box[:, 1, :1] >= 0, len(AROUND), axis=1)
        for axis in range(3):
            wanted &= (AROUND[:, axis] >= 0) | (box[:, 0, axis, None] < stage)
            wanted &= (AROUND[:, axis] <= 0) | (box[:, 1, axis, None] + stage > 7)
        leaves.add(leaves.around(*np.nonzero(wanted)))
        words = _stepped(leaves, leaves.extended(words, 8, 0), stage, neighbors, False)
    return words


def _stepped(leaves: LinkedLeaves, words: "wp.array", count: int, neighbors: str, shrink: bool) -> "wp.array":
    import warp as wp

    from geokit.volume import _bit_neighbours_kernels as kernels

    kernel = getattr(kernels, f"grow_{neighbors}_kernel")
    flip = wp.uint64((1 << 64) - 1 if shrink else 0)
    for _ in range(count):
        following = wp.empty_like(words)
        _launch.launch(kernel, len(words), [words, flip, leaves.beside], [following], leaves.device, grain=GRAIN)
        words = following
    return words


def _values(volume: SparseVolume) -> NDArray[Any]:
    """Values of the leaves in the order of the buffer, sharing its memory."""
    layout = LAYOUTS[volume.info.grid_type]
    tree = tree_header(volume.nanovdb)
    count = int(tree["node_count"][0])
    kind = layout.background
    row = LEAF_VOXELS * kind.itemsize
    if not count:
        return np.empty((0, LEAF_VOXELS, *kind.shape), kind.base)
    # The values are the last that a leaf holds, and fill a multiple of 32 bytes.
    begin = TREE_OFFSET + int(tree["node_offset"][0]) + layout.leaf_size - row
    rows = np.ndarray((count, row), np.uint8, volume.nanovdb, begin, (layout.leaf_size, 1))
    return np.ascontiguousarray(rows).view(kind.base).reshape(count, LEAF_VOXELS, *kind.shape)
