"""Normals of points: plane fits to neighborhoods, and consistent orientation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from geokit.core import launcher
from geokit.core.user_arrays import read_vectors, require_finite_scalar
from geokit.errors import InputError
from geokit.points._neighbors import NeighborGrid
from geokit.points.clouds.orientation import propagate_signs
from geokit.points.search.nearest import MAX_K, nearest
from geokit.points.search.nearest_tree import build_tree

if TYPE_CHECKING:
    import warp as wp

__all__ = ["PointNormals", "normals"]

ORIENTATIONS = ("propagation", "viewpoint", "none")
# Fewer points do not define a plane.
MIN_K = 3
# 1 / radius stays finite; shorter distances count as 0 in any case.
MAX_INVERSE = 1e300


class PointNormals(NamedTuple):
    """Normals of N points.

    Attributes:
        normals: Unit normals, or zeros where the neighborhood has no plane; shape (N, 3).
        curvature: Surface variation: the least eigenvalue of the neighborhood's covariance over the sum of all three; 0
            in a plane, 1/3 in a ball; shape (N,).
    """

    normals: Any
    curvature: Any


def normals(
    points: Any,
    *,
    k: int = 16,
    radius: float | None = None,
    orientation: str = "propagation",
    viewpoint: Any = None,
    device: Any = None,
) -> PointNormals:
    """Estimate normals of points from planes fitted to their neighborhoods.

    The neighborhood is the ``k`` nearest points, including the point itself (ties to the lowest index), or all points
    within ``radius``. The normal is the eigenvector of the least eigenvalue of the neighborhood's covariance.

    Normal and curvature are zero if the neighborhood has no plane: fewer than three points, all in one place, or in a
    line (narrower than 1e-7 of its length, or than four roundings of its coordinates).

    ``orientation`` sets the sign of a normal:

    - "propagation": signs propagate along a minimum spanning tree of the graph of the ``k`` nearest points, whose edges
      weigh 1 - abs(n_i . n_j). In each connected component the normal of the point with the largest z (lowest index
      among ties) points up. Well-sampled closed surfaces get outward normals.
    - "viewpoint": towards the viewpoint.
    - "none": the component of largest magnitude is positive.

    Error, with n neighbors: a normal deviates from the eigenvector of the exact covariance by at most (n + 128) * 2^-53
    times the largest eigenvalue over the gap between the two least, for any offset and scale of the points; curvature
    by (n + 16) * 2^-53. If the gap vanishes, as in a ball, no direction is preferred and any is returned. Results do
    not depend on the number of threads or on the device.

    Against the true surface: noise of a tenth of the spacing tilts normals by at most 15 degrees at k = 16. A
    neighborhood with a radius of up to 1.2 radii of curvature gives normals to 30 degrees at worst, 4 rms.

    Args:
        points: Positions [world], shape (N, 3), float32 or float64.
        k: Number of nearest points, 3 to 1024; also the degree of the graph along which signs propagate.
        radius: If given, neighborhoods are all points within this distance [world]; greater than 0.
        orientation: "propagation", "viewpoint" or "none".
        viewpoint: Position from which the points were seen [world], three numbers; required for "viewpoint", else not
            allowed.
        device: Where to compute: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Returns:
        PointNormals with normals (N, 3) and curvature (N,), in the container of the points.
    Raises:
        InputError: points is not (N, 3) or not finite; k is not a whole number from 3 to 1024; radius is not a finite
            number greater than 0; orientation is not known; viewpoint is missing, is not three finite numbers, or is
            given with another orientation; there is no such device.
        DeviceMemoryError: The nearest points of all points do not fit in memory: 12 k bytes a point.
    Source:
        Hoppe, DeRose, Duchamp, McDonald, Stuetzle, Surface reconstruction from unorganized points (1992). Differs: the
        connected components of the graph of nearest points are not joined; each has its own upward point. Curvature:
        Pauly, Gross, Kobbelt, Efficient simplification of point-sampled surfaces (2002).
    Example:
        >>> square = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
        >>> gk.points.normals(square, k=4, device="cpu").normals[0].tolist()
        [0.0, 0.0, 1.0]

    Held by: tests/points/clouds/test_normals.py, tests/points/clouds/test_normals_envelope.py,
    tests/accuracy/stability/test_envelopes.py
    """
    import warp as wp

    from geokit.points.clouds import normals_kernels as kernels

    k = _require_k(k)
    if radius is not None:
        radius = require_finite_scalar(radius, "radius", low=0.0)
    towards = _require_viewpoint(orientation, viewpoint)
    target = launcher.resolve_device(device)
    batch = read_vectors(points, "points", target)
    rows, count = batch.array, len(batch)
    normal = wp.zeros(count, dtype=wp.vec3d, device=target)
    curvature = wp.zeros(count, dtype=wp.float64, device=target)
    graph = None
    if count and (radius is None or orientation == "propagation"):
        graph = _graph(rows, min(k, count), target)
    if radius is not None:
        grid = NeighborGrid(rows, radius, device=target)._cells_for(radius).grid
        given = [grid, wp.float64(radius), wp.float64(_scale(grid, radius))]
        launcher.launch(kernels.within_plane_kernel, count, given, [normal, curvature], target)
    elif graph is not None:
        launcher.launch(kernels.nearest_plane_kernel, count, list(graph), [normal, curvature], target)
    if towards is not None:
        launcher.launch(kernels.towards_kernel, count, [rows, wp.vec3d(*towards)], [normal], target)
    elif graph is not None and orientation == "propagation":
        propagate_signs(rows, normal, graph.order, graph.neighbor, target)
    return PointNormals(batch.to_caller(normal), batch.to_caller(curvature))


class _Graph(NamedTuple):
    """The graph of nearest points, stored along a space-filling curve for locality in memory.

    Attributes:
        order: Indices of the points along the curve; shape (N,) or longer.
        points: The points along the curve.
        distance: Distances of the neighbors of each point, in the order of the caller's points; shape (N, k).
        neighbor: Positions on the curve of the neighbors of each point along it; shape (N, k).
    """

    order: "wp.array"
    points: "wp.array"
    distance: "wp.array"
    neighbor: "wp.array"


def _graph(rows: "wp.array", k: int, device: "wp.Device") -> _Graph:
    import warp as wp

    from geokit.points.clouds import normals_kernels as kernels

    count = len(rows)
    tree = build_tree(rows)
    distance, indices = nearest(tree, k, None)
    order = tree.index
    place = wp.empty(count, dtype=wp.int32, device=device)
    points = wp.empty(count, dtype=wp.vec3d, device=device)
    launcher.launch(kernels.place_kernel, count, [order, rows], [place, points], device)
    neighbor = wp.empty((count, k), dtype=wp.int32, device=device)
    launcher.launch(kernels.place_neighbors_kernel, count, [order, place, indices], [neighbor], device)
    return _Graph(order, points, distance, neighbor)


def _scale(grid: Any, radius: float) -> float:
    """Scale that brings differences within the radius to at most 1, and no smaller than needed."""
    lower, upper = (np.array(corner, dtype=np.float64) for corner in (grid.lower, grid.upper))
    longest = min(radius, float((upper - lower).max()) or radius)
    return min(1.0 / longest, MAX_INVERSE)


def _require_k(k: Any) -> int:
    if isinstance(k, bool) or not isinstance(k, (int, np.integer)) or not MIN_K <= k <= MAX_K:
        raise InputError(f"k: {k!r} is not a whole number from {MIN_K} to {MAX_K}; give one")
    return int(k)


def _require_viewpoint(orientation: str, viewpoint: Any) -> list[float] | None:
    if orientation not in ORIENTATIONS:
        raise InputError(f"orientation: {orientation!r} is not known; give 'propagation', 'viewpoint' or 'none'")
    if orientation != "viewpoint":
        if viewpoint is not None:
            raise InputError(f"viewpoint: orientation {orientation!r} takes none; give orientation='viewpoint'")
        return None
    if viewpoint is None:
        raise InputError("viewpoint: missing; orientation 'viewpoint' needs one")
    try:
        values = np.asarray(viewpoint, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"viewpoint: cannot be read as numbers ({error})") from error
    if values.shape != (3,) or not np.isfinite(values).all():
        raise InputError(f"viewpoint: {viewpoint!r} is not three finite numbers; give x, y and z")
    return [float(value) for value in values]
