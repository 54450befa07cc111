"""Farthest point sampling: each selected point is farthest from all earlier ones; bounding boxes prune the search."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from geokit.core import launcher
from geokit.core.scan import gathered
from geokit.points.search.cells import survey

if TYPE_CHECKING:
    import warp as wp

__all__ = ["farthest_points"]

# Exponents up to this keep scaled coordinates finite: an extent is at least a rounding of the largest coordinate.
MOST_SCALE_BITS = 960


def farthest_points(points: "wp.array", count: int, start: int) -> tuple["wp.array", "wp.array"]:
    """Select points by greedy farthest point sampling, in its order.

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
    import warp as wp

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
