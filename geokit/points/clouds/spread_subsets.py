"""Subsets of points that are far apart: Poisson-disk sampling and farthest point sampling."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.scan import flagged, gathered
from geokit.points.neighbors.neighbor_grid import NeighborGrid
from geokit.points.search.cells import survey

# Points whose rounded squared distance is at most the squared radius may be slightly farther apart than the radius: by
# five roundings of it, and by squares that vanish.
REACH_RELATIVE = 1e-15
REACH_ABSOLUTE = 1e-161
# Exponents up to this keep scaled coordinates finite: an extent is at least a rounding of the largest coordinate.
MOST_SCALE_BITS = 960


def poisson_disk_subset(points: "wp.array", radius: float, seed: int) -> tuple["wp.array", "wp.array"]:
    """A maximal subset of points that are at least the radius apart: of trying them sequentially in random order.

    Each round takes the undecided points that precede all their undecided neighbors in the order, then rejects the
    neighbors of taken points. The result equals that of the sequential method, whatever runs in parallel. The number of
    rounds grows with the logarithm of the number of points. Each round sorts the undecided points into cells in the
    order in which they are tried, because the points that a search sees first are then the most likely to precede.

    Args:
        points: vec3d positions (N,) [world].
        radius: Least distance [world].
        seed: Seed of the random order in which points are tried.
    Returns:
        The kept points, vec3d (M,) [world], and their indices (M,) int32, ascending.
    """
    from geokit.points.clouds import poisson_disk_kernels as kernels

    device: Any = points.device
    count = len(points)
    if count == 0:
        return points, wp.empty(0, dtype=wp.int32, device=device)
    # Masks compare with "at most": the largest number below the squared radius expresses "nearer than the radius".
    with np.errstate(over="ignore"):
        below = float(np.nextafter(np.float64(radius) * np.float64(radius), -np.inf))
    search = [wp.float64(radius * (1.0 + REACH_RELATIVE) + REACH_ABSOLUTE), wp.float64(below)]

    tried = np.random.default_rng(seed).permutation(count).astype(np.int32)
    waiting = wp.array(tried, dtype=wp.int32, device=device)
    taken = wp.zeros(count, dtype=wp.int32, device=device)
    while len(waiting):
        grid = NeighborGrid(gathered(points, waiting), radius, device=device)._cells_for(radius).grid
        # By sorted position: 1 is taken, 2 is rejected.
        state = wp.zeros(len(waiting), dtype=wp.int8, device=device)
        launcher.launch(kernels.take_kernel, len(waiting), [grid, *search], [state], device)
        launcher.launch(kernels.refuse_kernel, len(waiting), [grid, *search], [state], device)
        left = wp.empty(len(waiting), dtype=wp.int32, device=device)
        launcher.launch(kernels.outcome_kernel, len(waiting), [grid, state, waiting], [left, taken], device)
        waiting = gathered(waiting, flagged(left))
    kept = flagged(taken)
    return gathered(points, kept), kept


def farthest_points(points: "wp.array", count: int, start: int) -> tuple["wp.array", "wp.array"]:
    """Select points by greedy farthest point sampling, in its order: each is farthest from all earlier ones.

    Points in Morton order form leaves of 64 and groups of 64 leaves, each with a bounding box and the largest distance
    of its points from the selected ones. If a new point is no nearer to the box than that, nothing inside changes. The
    order affects only how much is skipped, never the result.

    Args:
        points: vec3d positions (N,) [world].
        count: Number of points to select, from 1 to N.
        start: Index of the first point.
    Returns:
        vec3d positions (count,) [world] and int32 indices (count,).
    """
    from geokit.points.clouds import farthest_points_kernels as kernels

    device: Any = points.device
    n = len(points)
    # Scaled by a power of two to about unit size: nothing is rounded, and no square vanishes or overflows.
    known = survey(points)
    exponent = -math.frexp(float((known.upper - known.lower).max()))[1]
    scale = wp.float64(math.ldexp(1.0, max(-MOST_SCALE_BITS, min(MOST_SCALE_BITS, exponent))))
    lower, upper = known.crowd
    order = launcher.morton_order(points, lower, float((upper - lower).max()), device)

    group_count = -(-n // int(kernels.GROUP_POINTS))
    # Groups are tested eight at a time.
    padded_groups = -(-group_count // 8) * 8
    leaf_count = padded_groups * int(kernels.GROUP_LEAVES)
    padded = group_count * int(kernels.GROUP_POINTS)
    cloud: Any = kernels.SampledCloud()
    cloud.x, cloud.y, cloud.z, cloud.squared = (wp.empty(padded, dtype=wp.float64, device=device) for _ in range(4))
    cloud.index = wp.empty(padded, dtype=wp.int32, device=device)
    first = wp.empty(1, dtype=wp.int32, device=device)
    launcher.launch(kernels.gather_kernel, padded, [points, order, scale, start, cloud], [first], device)
    for name, boxes in (("leaf", leaf_count), ("group", padded_groups)):
        setattr(cloud, f"{name}_box", wp.empty(6 * boxes, dtype=wp.float64, device=device))
        setattr(cloud, f"{name}_far", wp.empty(boxes, dtype=wp.float64, device=device))
        setattr(cloud, f"{name}_at", wp.empty(boxes, dtype=wp.int32, device=device))
    cloud.group_count = padded_groups
    launcher.launch(kernels.leaf_box_kernel, leaf_count, [cloud, n], [], device)
    launcher.launch(kernels.group_box_kernel, padded_groups, [cloud], [], device)

    indices = wp.empty(count, dtype=wp.int32, device=device)
    # Each step depends on the previous one: one CPU thread, or the threads of one GPU block.
    threads = 1 if device.is_cpu else launcher.BLOCK_DIM
    launcher.launch(kernels.greedy_kernel, threads, [cloud, first, count], [indices], device)
    return gathered(points, indices), indices
