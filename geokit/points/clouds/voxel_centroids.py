"""Centroids of the points in each voxel of a grid: points are sorted by voxel, then each run is summed."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory.unchecked import sort_pairs
from geokit.core.scan import gathered, prefix_sum
from geokit.errors import InputError
from geokit.points.search.cells import survey

# Beyond this, float64 does not represent consecutive whole voxel numbers.
MOST_VOXELS_FROM_ORIGIN = 2.0**52
# Most voxels of the bounding box that one 63-bit key can number.
MOST_KEYS = 2**62
# Counting by voxel needs a count of each voxel for each thread. If these are many more than the points, a sort is as
# fast and needs less memory. Positions are int32.
COUNTS_PER_POINT = 8
COUNTS_MORE = 1 << 16
MOST_COUNTS = 2**31 - 1
# Fewer points than this are processed by one thread: waking another takes longer.
COUNTED_SHARE = 1 << 18


class VoxelOrder(NamedTuple):
    """Points sorted by voxel, their indices, and the beginning of each voxel's points, with the total at the end."""

    points: "wp.array"
    index: "wp.array"
    begin: "wp.array"


def voxel_centroids(points: "wp.array", voxel_size: float) -> tuple["wp.array", "wp.array"]:
    """Centroids of the occupied voxels by ascending (z, y, x), and the point of each voxel nearest to its centroid.

    Args:
        points: vec3d positions (N,) [world].
        voxel_size: Edge length of a voxel [world].
    Returns:
        vec3d centroids (M,) [world] and int32 indices (M,).
    Raises:
        InputError: The voxels are too small for coordinates of this size.
    """
    from geokit.points.clouds.voxel_centroids_kernels import centroid_kernel

    device: Any = points.device
    known = survey(points)
    lower, upper = known.lower, known.upper
    require_resolved(lower, upper, voxel_size)
    order = _by_voxel(points, voxel_size, np.floor(lower / voxel_size), np.floor(upper / voxel_size))
    if not device.is_cpu:
        return centroids_by_pieces(order)
    count = len(order.begin) - 1
    centroids = wp.empty(count, dtype=wp.vec3d, device=device)
    indices = wp.empty(count, dtype=wp.int32, device=device)
    launcher.launch(centroid_kernel, count, [*order], [centroids, indices], device)
    return centroids, indices


def require_resolved(lower: NDArray[np.float64], upper: NDArray[np.float64], voxel_size: float) -> None:
    """Check that float64 tells voxels at the corners of a box apart.

    Raises:
        InputError: The voxels are too small.
    """
    with np.errstate(over="ignore"):
        farthest = max(np.abs(lower).max(), np.abs(upper).max())
        if farthest / voxel_size > MOST_VOXELS_FROM_ORIGIN:
            raise InputError(
                f"voxel_size: {voxel_size:g} is too small for coordinates of {farthest:g}, which float64 does not "
                f"resolve so finely; use {farthest / MOST_VOXELS_FROM_ORIGIN * 1.01:.3g} or more, or move the points "
                "next to the origin"
            )


def centroids_by_pieces(order: VoxelOrder) -> tuple["wp.array", "wp.array"]:
    """Same bits as with one thread for each voxel, with one thread for each piece of a voxel."""
    from geokit.points.clouds import voxel_centroids_kernels as kernels

    points, index, begin = order
    device: Any = points.device
    count = len(begin) - 1
    centroids = wp.empty(count, dtype=wp.vec3d, device=device)
    indices = wp.empty(count, dtype=wp.int32, device=device)
    if count == 0:
        return centroids, indices
    piece_count = wp.empty(count, dtype=wp.int32, device=device)
    launcher.launch(kernels.piece_count_kernel, count, [begin], [piece_count], device)
    piece_end, pieces = prefix_sum(piece_count)
    sums = wp.empty(pieces, dtype=wp.vec3d, device=device)
    launcher.launch(kernels.piece_sum_kernel, pieces, [points, begin, piece_end], [sums], device)
    means = wp.empty(count, dtype=wp.vec3d, device=device)
    launcher.launch(kernels.mean_kernel, count, [points, begin, piece_end, sums], [means, centroids], device)
    nearest = wp.empty(pieces, dtype=wp.int32, device=device)
    launcher.launch(kernels.piece_nearest_kernel, pieces, [points, begin, piece_end, means], [nearest], device)
    given = [points, index, begin, piece_end, means, nearest]
    launcher.launch(kernels.nearest_kernel, count, given, [indices], device)
    return centroids, indices


def _by_voxel(points: "wp.array", voxel_size: float, lower: Any, upper: Any) -> VoxelOrder:
    """Points sorted by voxel, within the box between two voxels given by whole numbers."""
    from geokit.points.clouds.voxel_centroids_kernels import VoxelBox

    # Whole numbers below 2^53: exact as Python's.
    sizes = [int(b) - int(a) + 1 for a, b in zip(lower, upper, strict=True)]
    voxel_count = sizes[0] * sizes[1] * sizes[2]
    count = len(points)
    if count == 0:
        return _sorted_by(points, None, 1)
    lows = [int(a) for a in lower]
    if voxel_count > MOST_KEYS:
        return _sorted_by(points, *_layer_keys(points, voxel_size, lows, sizes))
    shares = min(launcher.thread_count(), -(-count // COUNTED_SHARE))
    box: Any = VoxelBox()
    box.voxel_size, box.low, box.count = voxel_size, wp.vec3l(*lows), wp.vec3l(*sizes)
    if points.device.is_cpu and shares * voxel_count <= min(COUNTS_PER_POINT * count + COUNTS_MORE, MOST_COUNTS):
        return _counted(points, box, voxel_count, shares)
    return _sorted_by(points, _voxel_keys(points, box), voxel_count)


def _counted(points: "wp.array", box: Any, voxel_count: int, shares: int) -> VoxelOrder:
    """Counting sort on a CPU: each thread counts a share of the points by voxel, then places it."""
    from geokit.points.clouds.voxel_centroids_kernels import count_kernel, scatter_kernel

    device: Any = points.device
    count = len(points)
    length = -(-count // shares)
    keys = wp.empty(count, dtype=wp.int32, device=device)
    counts = np.zeros((shares, voxel_count), np.int32)
    out_counts = wp.array(counts.ravel(), dtype=wp.int32, device=device, copy=False)
    launcher.launch(count_kernel, shares, [points, box, length, voxel_count], [keys, out_counts], device, grain=1)
    total = counts.sum(axis=0, dtype=np.int32) if shares > 1 else counts[0]
    occupied = np.flatnonzero(total)
    begin = np.zeros(len(occupied) + 1, np.int32)
    np.cumsum(total[occupied], out=begin[1:])
    # Within a voxel, positions are assigned to the shares in order: its points keep their original order.
    place = begin[:-1].copy()
    for share in counts:
        own_counts = share[occupied]
        share[occupied] = place
        place += own_counts
    order = VoxelOrder(
        wp.empty(count, dtype=wp.vec3d, device=device),
        wp.empty(count, dtype=wp.int32, device=device),
        wp.array(begin, dtype=wp.int32, device=device),
    )
    given = [points, keys, length, voxel_count, out_counts]
    launcher.launch(scatter_kernel, shares, given, [order.points, order.index], device, grain=1)
    return order


def _voxel_keys(points: "wp.array", box: Any) -> "wp.array":
    """Number of each point's voxel in the box, in the first half of an array."""
    from geokit.points.clouds.voxel_centroids_kernels import key_kernel

    keys = wp.empty(2 * len(points), dtype=wp.int64, device=points.device)
    launcher.launch(key_kernel, len(points), [points, box], [keys], points.device)
    return keys


def _layer_keys(points: "wp.array", voxel_size: float, lows: list[int], sizes: list[int]) -> tuple["wp.array", int]:
    """Keys for a box with more voxels than 63 bits can number, in the first half of an array, and their number range.

    The occupied layers of each axis are numbered instead, at most 2^31 of them, and two axes are combined at a time.
    """
    from geokit.points.clouds.voxel_centroids_kernels import axis_key_kernel, join_kernel

    device: Any = points.device
    count, edge = len(points), wp.float64(voxel_size)

    def layers(axis: int) -> tuple["wp.array", int]:
        layer = wp.empty(2 * count, dtype=wp.int64, device=device)
        launcher.launch(axis_key_kernel, count, [points, edge, axis, wp.int64(lows[axis])], [layer], device)
        return _ranked(layer, count, sizes[axis])

    def joined(outer: "wp.array", inner: "wp.array", inner_count: int) -> "wp.array":
        keys = wp.empty(2 * count, dtype=wp.int64, device=device)
        launcher.launch(join_kernel, count, [outer, inner, wp.int64(inner_count)], [keys], device)
        return keys

    (z, count_z), (y, count_y), (x, count_x) = layers(2), layers(1), layers(0)
    zy, count_zy = _ranked(joined(z, y, count_y), count, count_z * count_y)
    return joined(zy, x, count_x), count_zy * count_x


def _ranked(keys: "wp.array", count: int, key_count: int) -> tuple["wp.array", int]:
    """Rank of each key among the distinct keys, ascending, and the number of distinct keys."""
    from geokit.points.clouds.voxel_centroids_kernels import rank_kernel

    order, numbers, distinct = _sorted_numbers(keys, count, key_count)
    ranks = wp.empty(count, dtype=wp.int32, device=keys.device)
    launcher.launch(rank_kernel, count, [order, numbers], [ranks], keys.device)
    return ranks, distinct


def _sorted_by(points: "wp.array", keys: Any, key_count: int) -> VoxelOrder:
    """Points sorted by ascending key, stable; the keys are in the first half of an array."""
    from geokit.points.clouds.voxel_centroids_kernels import begin_kernel

    device: Any = points.device
    count = len(points)
    if count == 0:
        none = wp.empty(0, dtype=wp.int32, device=device)
        return VoxelOrder(points, none, wp.zeros(1, dtype=wp.int32, device=device))
    order, numbers, run_count = _sorted_numbers(keys, count, key_count)
    begin = wp.empty(run_count + 1, dtype=wp.int32, device=device)
    launcher.launch(begin_kernel, count, [numbers], [begin], device)
    return VoxelOrder(gathered(points, order, count), order, begin)


def _sorted_numbers(keys: "wp.array", count: int, key_count: int) -> tuple["wp.array", "wp.array", int]:
    """The stable order that sorts the keys, for each sorted key the number of distinct keys up to it, and of all."""
    from geokit.core.morton_order_kernels import identity_kernel
    from geokit.points.clouds.voxel_centroids_kernels import head_kernel

    device: Any = keys.device
    # radix_sort_pairs uses the second half of both arrays as scratch space.
    order = wp.empty(2 * count, dtype=wp.int32, device=device)
    launcher.launch(identity_kernel, count, [], [order], device)
    sort_pairs(keys, order, count, end_bit=max(1, (key_count - 1).bit_length()))
    head = wp.empty(count, dtype=wp.int32, device=device)
    launcher.launch(head_kernel, count, [keys], [head], device)
    return order, *prefix_sum(head)
