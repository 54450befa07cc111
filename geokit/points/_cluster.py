"""Density-based clustering of points (DBSCAN) without storing neighbor lists."""

from __future__ import annotations

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.interop.types import Array, Device, Rows
from geokit.core.interop.user_arrays import read_vectors, require_finite_scalar
from geokit.core.memory.needs import needs, rows
from geokit.core.require import require_count
from geokit.points.neighbors.neighbor_grid import NeighborGrid

# Larger than every index.
NO_INDEX = 2**31 - 1


@needs(lambda points, **_: 48 * rows(points))
def cluster(points: Rows, *, radius: float, minimum_count: int = 5, device: Device = None) -> Array:
    """Cluster points by density (DBSCAN).

    A core point has at least ``minimum_count`` points within the radius, itself among them. Core points within the
    radius of each other are in one cluster. Any other point within the radius of a core point joins the cluster of the
    nearest core point (of the lowest index among equally near ones); otherwise it is noise. Clusters are numbered from
    0 by the lowest index of their core points.

    "Within" is ``(dx * dx + dy * dy) + dz * dz <= radius * radius`` in float64, as in :class:`NeighborGrid`. The labels
    follow this definition exactly, on every device and for any number of threads. Memory: the grid and 50 bytes a
    point; neighbor lists are never stored.

    Args:
        points: Positions [world], shape (N, 3), float32 or float64.
        radius: Largest distance between neighbors [world].
        minimum_count: Least number of points within the radius of a core point, itself included; 1 or more.
        device: Where to compute: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Returns:
        Labels (N,) int32, -1 for noise, in the container of the points.
    Raises:
        InputError: points is not (N, 3) or not finite; radius is negative or not a finite number; minimum_count is not
            a whole number of 1 or more; there is no such device.
    Source:
        Ester, Kriegel, Sander, Xu, A density-based algorithm for discovering clusters (1996). Differs: a border point
        joins its nearest core point. scikit-learn and Open3D give it to the cluster visited first, which depends on the
        order of the points.
    Example:
        >>> line = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 0, 0]]
        >>> gk.points.cluster(line, radius=1.0, minimum_count=3, device="cpu").tolist()
        [0, 0, 0, -1]
    """
    from geokit.points.clouds import cluster_kernels as kernels

    minimum_count = require_count(minimum_count, "minimum_count", 1)
    radius = require_finite_scalar(radius, "radius")
    target = launcher.resolve_device(device)
    batch = read_vectors(points, "points", target)
    neighbors = NeighborGrid(batch.array, radius, device=target)
    count, radius = len(batch), neighbors.radius
    counts = neighbors.count()
    grid = neighbors._cells_for(radius).grid
    core = wp.empty(count, dtype=wp.uint8, device=target)
    parent = wp.empty(count, dtype=wp.int32, device=target)
    given = [grid, counts, min(minimum_count, NO_INDEX)]
    launcher.launch(kernels.start_kernel, count, given, [core, parent], target)
    launcher.launch(kernels.join_kernel, count, [grid, radius, core], [parent], target)
    root = wp.empty(count, dtype=wp.int32, device=target)
    lowest = wp.full(count, NO_INDEX, dtype=wp.int32, device=target)
    launcher.launch(kernels.lowest_kernel, count, [grid, core, parent], [root, lowest], target)
    mark = wp.zeros(count, dtype=wp.int32, device=target)
    launcher.launch(kernels.mark_kernel, count, [core, root, lowest], [mark], target)
    if count:
        wp.utils.array_scan(mark, mark, inclusive=False)
    labels = counts
    launcher.launch(kernels.label_kernel, count, [grid, radius, core, root, lowest, mark], [labels], target)
    return batch.to_caller(labels)
