"""Downsampling of points: voxel centroids, farthest points, Poisson-disk subsets and covers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geokit.core import launcher
from geokit.core.interop.types import Array, Device, Rows
from geokit.core.interop.user_arrays import read_vectors, require_finite_scalar
from geokit.core.memory.needs import needs, rows
from geokit.core.require import require_count
from geokit.errors import InputError


class Downsampled(NamedTuple):
    """A cloud of fewer points.

    Attributes:
        points: The points [world], shape (M, 3).
        indices: The input point that each one is, or is nearest to, shape (M,) int32.
    """

    points: Array
    indices: Array


class Cover(NamedTuple):
    """A subset of the points, and its distance from the points left out.

    Attributes:
        points: The points kept, shape (M, 3) [world].
        indices: Their indices among the input points, shape (M,) int32, ascending.
        deviation: Largest distance of an input point from the nearest kept point [world], exact.
        deviation_p999: The 99.9th percentile of these distances [world].
    """

    points: Array
    indices: Array
    deviation: float
    deviation_p999: float


@needs(lambda points, **_: 80 * rows(points))
def downsample(
    points: Rows,
    *,
    voxel_size: float | None = None,
    count: int | None = None,
    radius: float | None = None,
    tolerance: float | None = None,
    start: int = 0,
    seed: int = 0,
    device: Device = None,
) -> Downsampled:
    """Reduce a cloud to fewer points by voxels, by number, by least distance or to a tolerance.

    Exactly one of ``voxel_size``, ``count``, ``radius`` and ``tolerance`` must be given; it selects the method. Every
    method gives the same bits on every device and for any number of threads.

    - ``voxel_size``: the centroids of the occupied voxels of a grid through the origin, in ascending (z, y, x). The
      voxel of a coordinate is ``floor(coordinate / voxel_size)`` in float64. A centroid is summed in float64 relative
      to the first point of its voxel; its error is one rounding of the coordinates plus n * 2^-53 of the voxel, with n
      the number of its points. ``indices`` gives the point of the voxel nearest to the centroid, for looking up other
      data of the points.
    - ``count``: farthest point sampling. Starting from point ``start``, each next point is the one farthest from all
      points taken so far; ties go to the lowest index, and no point is taken twice. The result is the exact greedy
      sequence, index for index, not an approximation of it. ``points`` and ``indices`` are in the order of selection.
    - ``radius``: a Poisson-disk subset. Points are tried in random order and kept unless a kept point is nearer than
      the radius. No two kept points are nearer to each other than the radius, and every other input point is nearer
      than the radius to a kept one. ``indices`` ascend. The order is
      ``numpy.random.default_rng(seed).permutation(len(points))``; "nearer" is
      ``(dx * dx + dy * dy) + dz * dz < radius * radius`` in float64.
    - ``tolerance``: a subset with a kept point within the tolerance of every input point: the Poisson-disk subset of
      that radius. :func:`cover` also returns the distances reached. The smallest such subset, for which no fast method
      is known, would have about a sixth fewer points (docs/design/simplification.md).

    Args:
        points: Positions [world], shape (N, 3), float32 or float64.
        voxel_size: Edge length of a voxel [world].
        count: Number of points to keep, from 1 to N.
        radius: Least distance between two kept points [world].
        tolerance: Largest distance of an input point from the nearest kept point [world].
        start: Index of the first point of farthest point sampling.
        seed: Seed of the random order of a Poisson-disk subset, 0 or more.
        device: Where to compute: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Returns:
        Downsampled with points (M, 3) [world] and indices (M,) int32, in the container of the points.
    Raises:
        InputError: points is not (N, 3) or not finite; not exactly one of voxel_size, count, radius and tolerance is
            given; one of them, start or seed is out of range; voxel_size is too small for float64 to tell the voxels
            of such coordinates apart; there is no such device.
    Source:
        Eldar, Lindenbaum, Porat, Zeevi, "The farthest point strategy for progressive image sampling" (1997), with the
        pruning by boxes of Han et al., "QuickFPS" (2023), on two levels of them; Blelloch, Fineman, Shun, "Greedy
        sequential maximal independent set and matching are parallel on average" (2012) for the Poisson-disk subset.
    Example:
        >>> line = [[0.1, 0, 0], [0.3, 0, 0], [1.2, 0, 0], [2.9, 0, 0]]
        >>> gk.points.downsample(line, voxel_size=1.0, device="cpu").points[:, 0].tolist()
        [0.2, 1.2, 2.9]
        >>> gk.points.downsample(line, count=3, device="cpu").indices.tolist()
        [0, 3, 2]
        >>> gk.points.downsample(line, radius=0.5, device="cpu").indices.tolist()
        [0, 2, 3]
    """
    given = {"voxel_size": voxel_size, "count": count, "radius": radius, "tolerance": tolerance}
    chosen = [name for name, value in given.items() if value is not None]
    if len(chosen) != 1:
        raise InputError(
            f"downsample: {' and '.join(chosen) or 'nothing'} given; give exactly one of voxel_size, count, radius and "
            "tolerance"
        )
    seed, start = require_count(seed, "seed"), require_count(start, "start")
    target = launcher.resolve_device(device)
    if chosen[0] == "voxel_size":
        size = require_finite_scalar(voxel_size, "voxel_size", low=0.0)
        batch = read_vectors(points, "points", target)
        from geokit.points.clouds.voxel_centroids import voxel_centroids

        return Downsampled(*map(batch.to_caller, voxel_centroids(batch.array, size)))
    if chosen[0] in ("radius", "tolerance"):
        distance = require_finite_scalar(given[chosen[0]], chosen[0], low=0.0)
        batch = read_vectors(points, "points", target)
        from geokit.points.clouds.spread_subsets import poisson_disk_subset

        return Downsampled(*map(batch.to_caller, poisson_disk_subset(batch.array, distance, seed)))
    wanted = require_count(count, "count", 1)
    batch = read_vectors(points, "points", target)
    if wanted > len(batch):
        raise InputError(f"count: {wanted} of {len(batch)} points; ask for as many as there are at most")
    start = require_count(start, "start", 0, len(batch) - 1)
    from geokit.points.clouds.spread_subsets import farthest_points

    return Downsampled(*map(batch.to_caller, farthest_points(batch.array, wanted, start)))


@needs(lambda points, **_: 90 * rows(points))
def cover(points: Rows, *, tolerance: float, seed: int = 0, device: Device = None) -> Cover:
    """Downsample to a tolerance and return the distances reached.

    The subset is that of :func:`downsample` with ``tolerance``. ``deviation`` is at most the tolerance and is exact for
    the float64 coordinates, rounded term by term. No two kept points are nearer to each other than the tolerance. The
    result has the same bits on every device and for any number of threads.

    Args:
        points: Positions [world], shape (N, 3), float32 or float64; at least one.
        tolerance: Largest distance of an input point from the nearest kept point [world].
        seed: Seed of the random order in which points are tried, 0 or more.
        device: Where to compute: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Returns:
        Cover with points (M, 3) [world] and indices (M,) int32 in the container of the points, deviation and
        deviation_p999 [world].
    Raises:
        InputError: points is not (N, 3), not finite or empty; tolerance is not a positive finite number; seed is out of
            range; there is no such device.
    Example:
        >>> line = [[0.1, 0, 0], [0.3, 0, 0], [1.2, 0, 0], [2.9, 0, 0]]
        >>> found = gk.points.cover(line, tolerance=0.5, device="cpu")
        >>> found.indices.tolist(), round(found.deviation, 12)
        ([0, 2, 3], 0.2)
    """
    target = launcher.resolve_device(device)
    distance = require_finite_scalar(tolerance, "tolerance", low=0.0)
    seed = require_count(seed, "seed", 0)
    batch = read_vectors(points, "points", target)
    if len(batch) == 0:
        raise InputError("points: a cloud without points has nothing to cover; give at least one")
    from geokit.points.clouds.spread_subsets import poisson_disk_subset
    from geokit.points.search.nearest import nearest
    from geokit.points.search.nearest_tree import build_tree

    kept, indices = poisson_disk_subset(batch.array, distance, seed)
    apart = nearest(build_tree(kept), 1, batch.array)[0].numpy().reshape(-1)
    percentile = float(np.quantile(apart, 0.999, method="higher"))
    return Cover(batch.to_caller(kept), batch.to_caller(indices), float(apart.max()), percentile)
