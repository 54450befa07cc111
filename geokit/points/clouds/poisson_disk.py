"""Poisson-disk subsets: the result of trying points sequentially in random order, computed in parallel rounds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import launcher
from geokit.core.scan import flagged, gathered
from geokit.points.neighbors.neighbor_grid import NeighborGrid

if TYPE_CHECKING:
    import warp as wp

__all__ = ["poisson_disk_subset"]

# Points whose rounded squared distance is at most the squared radius may be slightly farther apart than the radius: by
# five roundings of it, and by squares that vanish.
REACH_RELATIVE = 1e-15
REACH_ABSOLUTE = 1e-161


def poisson_disk_subset(points: "wp.array", radius: float, seed: int) -> tuple["wp.array", "wp.array"]:
    """A maximal subset of points that are at least the radius apart.

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
    import warp as wp

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
