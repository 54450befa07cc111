"""Finds the blocks of 8^3 cells that may hold a crossing of an isovalue ("busy blocks"), and their busy cells.

With these tables a ray reads 128 bytes for each block near a level set's surface, instead of the two kilobytes of a
leaf and those of its neighbors, and never walks the tree.

- reach: the distance [blocks] to the nearest busy block ahead (Chebyshev distance), one byte per block of the box
  around the stored voxels, x slowest; 0 for a busy block. A border of one block around the box holds -1. There are
  eight copies, one for each octant of ray directions: 4, 2 and 1 are added for backwards along x, y and z. Rays read
  nothing else on most of their way.
- numbers: the row of a block in `blocks`.
- first_block, block_count: the first block, relative to the anchor voxel, and the number of blocks along each axis.
- blocks: BLOCK_WORDS words for each busy block: for each x the bits 8 y + z of the busy cells, then the nodes of the
  block and of the seven beside it, z fastest: leaves, with their lowest bit set, or tiles.
"""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Words of a busy block.
BLOCK_WORDS = 16
# Largest distance [blocks] that is stored; the gain is in the first steps.
FARTHEST = wp.constant(32)


NUMBERS = {"FARTHEST": int(FARTHEST), "BLOCK_WORDS": BLOCK_WORDS}


# ``below`` and ``above`` are the voxel type's numbers below and above the isovalue: float32 for grids of floats,
# float64 for all other types.
@wp.kernel
@cpp.native_item("volume/rays/crossing_blocks.inl", "mark_row", **NUMBERS)
def mark_blocks_kernel(first: int, below: Any, above: Any): ...


@wp.kernel
@cpp.native_item("volume/rays/crossing_blocks.inl", "write_row", **NUMBERS)
def write_blocks_kernel(first: int, below: Any, above: Any): ...


def by_voxel(kernel: Any) -> dict[bool, Any]:
    """Overloads of a kernel with ``below`` and ``above``, keyed by whether the grid holds floats."""
    kinds = {True: wp.float32, False: wp.float64}
    return {is_float: wp.overload(kernel, {"below": real, "above": real}) for is_float, real in kinds.items()}


MARK_BLOCKS, WRITE_BLOCKS = by_voxel(mark_blocks_kernel), by_voxel(write_blocks_kernel)


@wp.kernel
def spread_distance_kernel(
    first: int,
    total: int,
    stride: int,
    count: int,
    distance: wp.array(dtype=wp.int8),
    out_distance: wp.array(dtype=wp.int8),
):
    """Extends distances along one more axis, whose lines have ``count`` blocks that are ``stride`` elements apart.

    Each part of ``total`` distances becomes two: one for rays forwards along the axis, one for rays backwards.
    """
    k = first + wp.tid()
    part = k // total
    n = k - part * total
    at = (part // 2) * total + n
    best = int(distance[at])
    if best > 0:
        i = (n // stride) % count
        room = count - 1 - i
        step = stride
        if part % 2 == 1:
            room = i
            step = -stride
        r = int(1)
        while r < best and r <= room:
            at += step
            other = int(distance[at])
            if other >= 0:
                best = wp.min(best, wp.max(r, other))
            r += 1
    out_distance[k] = wp.int8(best)


@wp.kernel
@cpp.native_item("volume/rays/crossing_blocks.inl", "spread_line", **NUMBERS)
def spread_lines_kernel(first: int):
    """Does the same as spread_distance_kernel; an item is a line of ``length`` blocks along z."""
