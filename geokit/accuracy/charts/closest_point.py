"""Charts of closest points: the cost of exactness, and the gain from a search radius."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import held_bytes, judged, on_host, send, setting_of

if TYPE_CHECKING:
    from geokit.accuracy.charts.mesh_setup import MeshSetup, Queries

__all__ = ["closest_point_charts", "warp_tree_bytes"]

# Search radii [diagonals].
RADII = (0.1, 0.01)
# Distances closer to the search radius than this [diagonals] may count as within or beyond it.
BORDER = 1e-9
# Memory of warp's tree for each triangle [bytes], from docs/kernels.md.
WARP_TREE = 100


def closest_point_charts(setup: MeshSetup) -> list[Chart]:
    """Errors of closest points, for queries anywhere and near the surface.

    An error is the larger of two: the deviation of ``distance`` from the reference, and that of the distance from the
    query to the returned point. Misses within the search radius and hits beyond it are wrong.
    """
    title = "Closest point on the surface"
    return [
        Chart("closest_point", title, "world", "queries", lambda: _trials(setup, setup.uniform())),
        Chart("closest_point_near", f"{title}, near it", "world", "queries", lambda: _trials(setup, setup.near())),
    ]


def warp_tree_bytes(setup: MeshSetup) -> int:
    """Estimated memory of warp's tree of the mesh, which is not visible in any array."""
    return WARP_TREE * len(setup.mesh.faces)


def _trials(setup: MeshSetup, queries: Queries) -> Iterator[Trial]:
    import warp as wp

    from geokit.accuracy.charts.raw_queries import raw_closest_point
    from geokit.mesh.surfaces.surface import Surface

    surface, points = setup.surface, send(queries.points, setup.device)
    size = held_bytes(surface)
    known = cache(partial(reference.closest_point, setup.mesh.vertices, setup.mesh.faces, queries.checked))

    def trial(method: str, run: Callable[[], Any], byte_count: int, reach: float, **parameters: Any) -> Trial:
        parameters["max_distance"] = reach
        judge = partial(_judge, setup, queries, known, reach)
        return Trial(method, setting_of(parameters), run, judge, setup.count, byte_count, parameters)

    for reach in (np.inf, *map(setup.shared, RADII)):
        ask = partial(surface.closest_point, points, max_distance=reach)
        yield trial("closest_point, float64", ask, size, reach)
    single = wp.array(queries.points.astype(np.float32), dtype=wp.vec3f, device=setup.device)
    yield trial("closest_point, float32", partial(surface.closest_point, single), size, np.inf)

    def made_and_asked() -> Any:
        return Surface(setup.mesh, device=setup.device).closest_point(points)

    yield trial("Surface made and asked, float64", made_and_asked, 0, np.inf)
    size = warp_tree_bytes(setup)
    yield trial("warp.mesh_query_point, float32", lambda: raw_closest_point(surface, points), size, np.inf)


def _judge(
    setup: MeshSetup, queries: Queries, known: Callable[[], reference.ClosestReference], reach: float, answer: Any
) -> Judgement:
    wanted = known().distance
    hit = on_host(answer.triangle_id)[queries.rows] >= 0
    wrong = (hit != (wanted <= reach)) & ~(np.abs(wanted - reach) <= BORDER * setup.size)
    both = hit & (wanted <= reach)
    distance = np.where(both, on_host(answer.distance)[queries.rows], wanted)
    apart = np.linalg.norm(on_host(answer.points)[queries.rows] - queries.checked, axis=1)
    apart = np.where(both, apart, wanted)
    errors = np.maximum(np.abs(distance - wanted), np.abs(apart - wanted))
    return judged(errors, queries.checked, wrong)
