"""Detection of outliers: points far from the others."""

from __future__ import annotations

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.interop.types import Array, Device, Rows
from geokit.core.interop.user_arrays import LARGEST_MEASURED, read_vectors, require_finite_scalar
from geokit.core.memory.needs import needs, rows
from geokit.core.require import require_choice, require_count
from geokit.errors import InputError
from geokit.points.neighbors.neighbor_grid import NeighborGrid
from geokit.points.search.nearest import MAX_K, nearest
from geokit.points.search.nearest_tree import build_tree

METHODS = ("statistical", "radius")


@needs(lambda points, **_: 210 * rows(points))
def outliers(
    points: Rows,
    *,
    method: str = "statistical",
    k: int = 16,
    ratio: float = 2.0,
    radius: float | None = None,
    minimum_count: int = 2,
    device: Device = None,
) -> Array:
    """Mark points that are isolated from the others.

    - "statistical": points whose mean distance to their ``k`` nearest other points exceeds the mean of all such means
      by more than ``ratio`` times their standard deviation (with N - 1). If there are fewer than ``k`` other points,
      all are used.
    - "radius": points with fewer than ``minimum_count`` other points within the radius
      (``(dx * dx + dy * dy) + dz * dz <= radius * radius`` in float64).

    The neighbors and their distances are exact. A mean has a relative error of (k + 2) * 2^-53; the mean and the
    deviation of all means have one of about 2^-50. Only points as close to the threshold as that may differ from the
    definition. The result does not depend on the device or on the number of threads.

    Args:
        points: Positions [world], shape (N, 3), float32 or float64.
        method: "statistical" or "radius".
        k: Number of nearest other points whose distances are averaged, 1 to 1024.
        ratio: Standard deviations above the mean at which the threshold lies.
        radius: Largest distance between neighbors [world]; required for "radius", else not allowed.
        minimum_count: Least number of other points within the radius of an inlier; 1 or more.
        device: Where to compute: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Returns:
        Mask (N,) bool, True for outliers, in the container of the points. A single point is not an outlier for
        "statistical".
    Raises:
        InputError: points is not (N, 3) or not finite; method is neither; k, ratio, radius or minimum_count is out of
            range; radius is missing, or given with "statistical"; there is no such device.
        DeviceMemoryError: The nearest points of all points do not fit in memory: 12 k bytes a point.
    Source:
        Rusu, Marton, Blodow, Dolha, Beetz, Towards 3D point cloud based object maps (2008). The definitions are those
        of PCL's StatisticalOutlierRemoval and RadiusOutlierRemoval. Open3D counts a point among its own nearest points:
        ``nb_neighbors = k + 1`` there is ``k`` here. Differs from Open3D: a point whose neighbors all coincide with it
        is not an outlier.
    Example:
        >>> line = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [90, 0, 0]]
        >>> gk.points.outliers(line, method="radius", radius=1.5, minimum_count=1, device="cpu").tolist()
        [False, False, False, False, True]
    """
    from geokit.points.clouds.outliers_kernels import below_kernel

    require_choice(method, "method", METHODS)
    target = launcher.resolve_device(device)
    k, ratio = require_count(k, "k", 1, MAX_K), require_finite_scalar(ratio, "ratio")
    fewest = require_count(minimum_count, "minimum_count", 1, 2**31 - 1)
    if method == "radius":
        if radius is None:
            raise InputError("radius: missing; method 'radius' needs one")
        batch = read_vectors(points, "points", target, largest=LARGEST_MEASURED)
        counts = NeighborGrid(batch.array, radius, device=target).count(exclude_self=True)
        mask = wp.empty(len(batch), dtype=wp.bool, device=target)
        launcher.launch(below_kernel, len(batch), [counts, fewest], [mask], target)
        return batch.to_caller(mask)
    if radius is not None:
        raise InputError("radius: method 'statistical' takes none; give method='radius', or k and ratio")
    batch = read_vectors(points, "points", target, largest=LARGEST_MEASURED)
    return batch.to_caller(_unusual(batch.array, k, ratio, target))


def _unusual(rows: "wp.array", k: int, ratio: float, device: "wp.Device") -> "wp.array":
    from geokit.points.clouds.outliers_kernels import above_kernel, mean_distance_kernel

    count = len(rows)
    mask = wp.zeros(count, dtype=wp.bool, device=device)
    if count < 2:
        return mask
    distance, _ = nearest(build_tree(rows), min(k, count - 1), None, exclude_self=True)
    mean = wp.empty(count, dtype=wp.float64, device=device)
    launcher.launch(mean_distance_kernel, count, [distance], [mean], device)
    threshold = wp.float64(_threshold(mean.numpy(), ratio))
    launcher.launch(above_kernel, count, [mean, threshold], [mask], device)
    return mask


def _threshold(means: np.ndarray, ratio: float) -> float:
    # Relative to the least mean, so that rounding cannot put equal means above their own average.
    least = means.min()
    above = means - least
    # Relative to the greatest mean, so that squares neither vanish nor overflow.
    greatest = above.max() or 1.0
    above /= greatest
    return float(least + greatest * (above.mean() + ratio * above.std(ddof=1)))
