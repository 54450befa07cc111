"""Warp's own float32 queries on structures prepared by geokit, through the handles for user kernels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from geokit.core import launcher
from geokit.core.base.late_warp import wp

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface
    from geokit.points.neighbors.neighbor_grid import NeighborGrid


class RawClosest(NamedTuple):
    """points (N, 3) [world], distance (N,) [world], triangle_id (N,); -1 and inf for a miss."""

    points: Any
    distance: Any
    triangle_id: Any


class RawHits(NamedTuple):
    """t (N,) in units of the direction, triangle_id (N,); inf and -1 for a miss."""

    t: Any
    triangle_id: Any


def raw_closest_point(surface: Surface, points: "wp.array") -> RawClosest:
    """Closest points (vec3d in, float32 out) by ``wp.mesh_query_point_no_sign``."""
    from geokit.accuracy.charts.raw_queries_kernels import raw_closest_point_kernel

    device, count = points.device, len(points)
    found = RawClosest(*(wp.empty(count, dtype=dtype, device=device) for dtype in (wp.vec3f, wp.float32, wp.int32)))
    launcher.launch(raw_closest_point_kernel, count, [*_frame(surface), points], list(found), device)
    return found


def raw_raycast(surface: Surface, origins: "wp.array", directions: "wp.array") -> RawHits:
    """First hits (vec3d in, float32 out) by ``wp.mesh_query_ray``."""
    from geokit.accuracy.charts.raw_queries_kernels import raw_raycast_kernel

    device, count = origins.device, len(origins)
    found = RawHits(*(wp.empty(count, dtype=dtype, device=device) for dtype in (wp.float32, wp.int32)))
    launcher.launch(raw_raycast_kernel, count, [*_frame(surface), origins, directions], list(found), device)
    return found


def raw_radius_count(grid: NeighborGrid, points: "wp.array", queries: "wp.array", radius: float) -> "wp.array":
    """Number of points (vec3f) within the radius of each query (vec3f), by ``wp.hash_grid_query``."""
    from geokit.accuracy.charts.raw_queries_kernels import raw_radius_count_kernel

    device, count = queries.device, len(queries)
    counts = wp.empty(count, dtype=wp.int32, device=device)
    launcher.launch(raw_radius_count_kernel, count, [wp.uint64(grid.id), points, queries, radius], [counts], device)
    return counts


def _frame(surface: Surface) -> list[Any]:
    return [wp.uint64(surface.id), wp.vec3d(*surface.origin), wp.float64(surface.scale)]
