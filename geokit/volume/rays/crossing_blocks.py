"""Finds the blocks of a volume that may hold a crossing of an isovalue, once, and caches them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.launches import captured, prepared
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.rays.ray_field import LEAF_SPAN, anchor_of, stored_box

# Testing a block takes about a fourth of the time of a ray. With fewer rays the search does not pay.
BLOCKS_PER_RAY = 4
# Most blocks that are tested: twelve bytes each, 192 MiB. Wider grids are traversed without this table.
MOST_BLOCKS = 1 << 24
# Results that are kept for each volume, by device and isovalue.
REMEMBERED = 4
# Fewest rows of blocks per slice of a launch: for testing blocks, and for spreading distances.
GRAIN = 4
LINE_GRAIN = 128


class CrossingBlocks(NamedTuple):
    """Blocks that may hold a crossing of an isovalue, as described in crossing_blocks_kernels."""

    reach: "wp.array"
    numbers: "wp.array"
    first_block: Any
    block_count: Any
    blocks: "wp.array"


def crossing_blocks(
    volume: SparseVolume, levels: list[Any], ray_count: int, device: "wp.Device"
) -> CrossingBlocks | None:
    """The blocks and cells of a volume in which a ray may cross an isovalue.

    Args:
        volume: A grid of one component.
        levels: The voxel type's numbers below and above the isovalue: two wp.float32 for a float grid, else two
            wp.float64.
        ray_count: Number of rays in this call.
        device: Device of the rays.
    Returns:
        The blocks; None if finding them would take longer than casting the rays without them, or too much memory.
    """
    remembered = known_blocks(volume)
    key = (device.alias, *(float(level) for level in levels))
    if key not in remembered:
        box = stored_box(volume)
        if box is None:
            return None
        anchor = anchor_of(box)
        # Cells start one voxel below the first voxel; a border of one block ends the walk.
        first = (box[0] - 1 - anchor) // LEAF_SPAN - 1
        count = (box[1] - anchor) // LEAF_SPAN + 2 - first
        total = math.prod(count.tolist())
        if captured.is_captured(device) or total > min(MOST_BLOCKS, BLOCKS_PER_RAY * ray_count):
            return None
        prepared.refuse()
        while len(remembered) >= REMEMBERED:
            remembered.pop(next(iter(remembered)))
        remembered[key] = _find(volume, levels, device, anchor, first, count)
    return remembered[key]


def known_blocks(volume: SparseVolume) -> dict[Any, CrossingBlocks]:
    """The blocks that are kept with a volume, by device and levels."""
    return volume._cache.find("crossing blocks", dict)


def _find(
    volume: SparseVolume,
    levels: list[Any],
    device: "wp.Device",
    anchor: NDArray[np.int64],
    first: NDArray[np.int64],
    count: NDArray[np.int64],
) -> CrossingBlocks:
    from geokit.volume.rays import crossing_blocks_kernels as kernels

    single = volume.info.grid_type == "float"
    first_block, block_count = wp.vec3i(*first.tolist()), wp.vec3i(*count.tolist())
    rows, total = int(count[0] * count[1]), math.prod(count.tolist())
    busy = wp.empty(total + 1, dtype=wp.int32, device=device)
    numbers = wp.empty(total + 1, dtype=wp.int32, device=device)
    inputs = [wp.uint64(volume.id(device)), wp.vec3i(*anchor.tolist()), first_block, block_count, *levels]
    launcher.launch(kernels.MARK_BLOCKS[single], rows, inputs, [busy], device, grain=GRAIN)
    wp.utils.array_scan(busy, numbers, inclusive=False)
    found = int(numbers[total:].numpy()[0])
    blocks = wp.empty(kernels.BLOCK_WORDS * max(found, 1), dtype=wp.uint64, device=device)
    reach = wp.empty(total, dtype=wp.int8, device=device)
    launcher.launch(kernels.WRITE_BLOCKS[single], rows, [*inputs, numbers], [reach, blocks], device, grain=GRAIN)
    stride = total
    for along in count.tolist():
        stride //= along
        wider = wp.empty(2 * reach.size, dtype=wp.int8, device=device)
        if device.is_cpu:
            across = [total, stride, along, int(count[2]), reach]
            lines = wider.size // int(count[2])
            launcher.launch(kernels.spread_lines_kernel, lines, across, [wider], device, grain=LINE_GRAIN)
        else:
            launcher.launch(kernels.spread_distance_kernel, wider.size, [total, stride, along, reach], [wider], device)
        reach = wider
    return CrossingBlocks(reach, numbers, first_block, block_count, blocks)
