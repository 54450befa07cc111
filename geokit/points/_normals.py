"""Normals of points: plane fits to neighborhoods, and consistent orientation."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.interop.types import Array, Device, Rows
from geokit.core.interop.user_arrays import read_vectors, require_finite_scalar
from geokit.core.memory.needs import needs, rows
from geokit.core.require import require_choice, require_count, require_table
from geokit.errors import InputError
from geokit.points.clouds.orientation import propagate_signs
from geokit.points.neighbors.neighbor_grid import NeighborGrid
from geokit.points.search.nearest import MAX_K, nearest
from geokit.points.search.nearest_tree import build_tree

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

    normals: Array
    curvature: Array


def _bytes(points: Any, *, k: int = 16, orientation: str = "propagation", **_: Any) -> float:
    return rows(points) * (120 + (26 if orientation == "propagation" else 12) * k)


@needs(_bytes)
def normals(
    points: Rows,
    *,
    k: int = 16,
    radius: float | None = None,
    orientation: str = "propagation",
    viewpoint: ArrayLike | None = None,
    device: Device = None,
) -> PointNormals:
    """Estimate normals of points from planes fitted to their neighborhoods.

    The neighborhood is the ``k`` nearest points, including the point itself (ties to the lowest index), or all points
    within ``radius``. The normal is the eigenvector of the least eigenvalue of the neighborhood's covariance.

    Normal and curvature are zero if the neighborhood has no plane: fewer than three points, all in one place, or in a
    line (narrower than 1e-7 of its length, or than four roundings of its coordinates).

    ``orientation`` sets the sign of a normal:

    - "propagation": neighbors in the graph of the ``k`` nearest points agree. An edge compares two normals as they are
      and after reflection in the plane halfway between the points, and counts where both say the same: not through a
      thin body. Clusters of points join by the votes of all edges between them. Each connected component is turned so
      that the volume above its lowest point, or above the clearest of three heights, is positive: closed surfaces get
      outward normals, height fields upward ones. Surfaces that no edge joins are separate components.
    - "viewpoint": towards the viewpoint.
    - "none": the component of largest magnitude is positive.

    Error, with n neighbors: a normal deviates from the eigenvector of the exact covariance by at most (n + 128) * 2^-53
    times the largest eigenvalue over the gap between the two least, for any offset and scale of the points; curvature
    by (n + 16) * 2^-53. If the gap vanishes, as in a ball, no direction is preferred and any is returned. Results do
    not depend on the number of threads or on the device.

    Against the true surface: noise of a tenth of the spacing tilts normals by at most 15 degrees at k = 16. A
    neighborhood with a radius of up to 1.2 radii of curvature gives normals to 30 degrees at worst, 4 rms.

    Propagated signs, for random points at k = 16, lengths in spacings (the side of a point's share of the surface):
    closed plates of thickness 2.4 and more have at most 0.6 % wrong signs, 0.3 % from 2.7 on, 4 % at 2.1; tubes of
    diameter 3 have 0.1 %; noise of 0.3 leaves 0.6 % wrong on plates of 3.2, noise of 0.5 leaves 3 % on boxes. Spheres
    2.5 and sheets 3 apart have one sign each but for 0.6 and 1.5 %; whether it is the same is open. Thinner bodies, and
    edges sharper than about 60 degrees, whose sides have their normals averaged, may have half of their signs wrong.

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
        Hoppe, DeRose, Duchamp, McDonald, Stuetzle, Surface reconstruction from unorganized points (1992). Differs:
        edges count as above, with the reflection of Xie, Wang, Hua, Qin, Kaufman, Piecewise C1 continuous surface
        reconstruction of noisy point clouds via local implicit quadric regression (2003); clusters vote; components
        are not joined. Curvature: Pauly, Gross, Kobbelt, Efficient simplification of point-sampled surfaces (2002).
    Example:
        >>> square = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
        >>> gk.points.normals(square, k=4, device="cpu").normals[0].tolist()
        [0.0, 0.0, 1.0]
    """
    k = require_count(k, "k", MIN_K, MAX_K)
    if radius is not None:
        radius = require_finite_scalar(radius, "radius", low=0.0)
    towards = _require_viewpoint(orientation, viewpoint)
    target = launcher.resolve_device(device)
    batch = read_vectors(points, "points", target)
    normal, curvature, graph = planes(batch.array, k, radius, target, graph_too=orientation == "propagation")
    if towards is not None:
        turn_towards(normal, batch.array, towards, target)
    elif graph is not None and orientation == "propagation":
        propagate_signs(graph.points, normal, graph.order, graph.distance, graph.neighbor, target)
    return PointNormals(batch.to_caller(normal), batch.to_caller(curvature))


def planes(
    rows: "wp.array", k: int, radius: float | None, device: "wp.Device", *, graph_too: bool = False
) -> tuple["wp.array", "wp.array", "_Graph | None"]:
    """Normals and curvatures of vec3d points, unoriented, and the graph where the nearest points are used."""
    from geokit.points.clouds import normals_kernels as kernels

    count = len(rows)
    normal = wp.zeros(count, dtype=wp.vec3d, device=device)
    curvature = wp.zeros(count, dtype=wp.float64, device=device)
    graph = _graph(rows, min(k, count), device) if count and (radius is None or graph_too) else None
    if radius is not None:
        grid = NeighborGrid(rows, radius, device=device)._cells_for(radius).grid
        given = [grid, wp.float64(radius), wp.float64(_scale(grid, radius))]
        launcher.launch(kernels.within_plane_kernel, count, given, [normal, curvature], device)
    elif graph is not None:
        launcher.launch(kernels.nearest_plane_kernel, count, list(graph), [normal, curvature], device)
    return normal, curvature, graph


def turn_towards(normal: "wp.array", rows: "wp.array", viewpoint: list[float], device: "wp.Device") -> None:
    """Turn the normals of vec3d points towards a viewpoint."""
    from geokit.points.clouds import normals_kernels as kernels

    launcher.launch(kernels.towards_kernel, len(rows), [rows, wp.vec3d(*viewpoint)], [normal], device)


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


def _require_viewpoint(orientation: str, viewpoint: Any) -> list[float] | None:
    require_choice(orientation, "orientation", ORIENTATIONS)
    if orientation != "viewpoint":
        if viewpoint is not None:
            raise InputError(f"viewpoint: orientation {orientation!r} takes none; give orientation='viewpoint'")
        return None
    if viewpoint is None:
        raise InputError("viewpoint: missing; orientation 'viewpoint' needs one")
    return [float(value) for value in require_table(viewpoint, "viewpoint", (3,))]
