"""Charts of first hits: exact, or warp's own, and through a distance field instead of triangles."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.charts.closest_point import warp_tree_bytes
from geokit.accuracy.charts.mesh_setup import SEED
from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import failed, held_bytes, judged, on_host, send, setting_of, unit
from geokit.errors import GeokitError

if TYPE_CHECKING:
    from geokit.accuracy.charts.mesh_setup import MeshSetup

Floats = NDArray[np.float64]

# Rays start on a sphere of this radius around the center of the bounding box [diagonals].
START = 1.0
# Two hits farther apart than this [diagonals] are on different parts of the surface: the rays passed a silhouette on
# different sides.
ELSEWHERE = 0.02
# Rays through edges are repeated, displaced by this much [diagonals]: rays whose answers differ touch a silhouette, and
# may hit or miss. One copy is moved onto a face of the edge, the others all around.
ASIDE = 1e-9
AROUND = 6
# Allowed difference of such answers [diagonals]: the effect of ASIDE on a grazing ray.
TOUCH = 1e-6
# Voxel sizes [diagonals], in quick charts and in full ones.
QUICK_DIVISIONS = (32, 96)
DIVISIONS = (32, 64, 128, 256)


class Rays(NamedTuple):
    """Origins and unit directions (N, 3) [world], and the rows that are checked."""

    origins: Floats
    directions: Floats
    rows: NDArray[np.int64]


class Known(NamedTuple):
    """t of the checked rays, inf for a miss, and a mask of the rays that count."""

    t: Floats
    counts: NDArray[np.bool_]


def first_hit_charts(setup: MeshSetup) -> list[Chart]:
    """Errors of t for rays from all around, and shares of leaks for rays aimed at edges and vertices.

    Hits instead of misses, misses instead of hits, and hits elsewhere are wrong: the silhouette is displaced. Rays at
    edges that touch a silhouette are left out.
    """
    title = "First hit of a ray"
    return [
        Chart("first_hit", title, "world", "rays", lambda: _trials(setup)),
        Chart(
            "first_hit_edges", f"{title} through an edge or a vertex", "world", "rays", lambda: _leaks(setup), "wrong"
        ),
    ]


def _trials(setup: MeshSetup) -> Iterator[Trial]:
    lower, upper = setup.mesh.bounds
    targets = np.random.default_rng(SEED + 4).uniform(lower, upper, (setup.count, 3))
    rays = _aimed(setup, targets, setup.rows())
    judge = partial(_judge, setup, rays, cache(partial(_first, setup, rays)))
    yield from _of_mesh(setup, rays, judge)
    yield from _of_volumes(setup, rays, judge)


def _leaks(setup: MeshSetup) -> Iterator[Trial]:
    targets, middles = _on_edges(setup)
    rays = _aimed(setup, targets, setup.rows(AROUND + 2))
    known = _undoubted(setup, rays, (middles - targets)[rays.rows])
    # On a mesh that consists only of silhouettes no ray remains.
    if known.counts.any():
        yield from _of_mesh(setup, rays, partial(_judge, setup, rays, lambda: known))


def _of_mesh(setup: MeshSetup, rays: Rays, judge: Callable[[Any], Judgement]) -> Iterator[Trial]:
    from geokit.accuracy.charts.raw_queries import raw_raycast

    surface, size = setup.surface, held_bytes(setup.surface)
    origins, directions = send(rays.origins, setup.device), send(rays.directions, setup.device)
    run = partial(surface.raycast, origins, directions)
    yield Trial("raycast", "as it is", run, judge, setup.count, size)
    size = warp_tree_bytes(setup)

    run_raw = partial(raw_raycast, surface, origins, directions)
    yield Trial("warp.mesh_query_ray, float32", "as it is", run_raw, judge, setup.count, size)


def _of_volumes(setup: MeshSetup, rays: Rays, judge: Callable[[Any], Judgement]) -> Iterator[Trial]:
    origins, directions = send(rays.origins, setup.device), send(rays.directions, setup.device)
    for parts in QUICK_DIVISIONS if setup.quick else DIVISIONS:
        chosen = {"voxel_size": setup.shared(1.0 / parts)}
        try:
            volume = setup.level_set(chosen["voxel_size"])
        except GeokitError as error:
            yield failed("volume.raycast", chosen, error)
            continue
        run = partial(volume.raycast, origins, directions, device=setup.device)
        yield Trial("volume.raycast", setting_of(chosen), run, judge, setup.count, volume.info.byte_count, chosen)


def _aimed(setup: MeshSetup, targets: Floats, rows: NDArray[np.int64]) -> Rays:
    """Rays towards the targets from a sphere around the mesh."""
    rng = np.random.default_rng(SEED + 3)
    outward = unit(rng.normal(size=targets.shape))
    origins = setup.mesh.bounds.mean(axis=0) + START * setup.size * outward
    return Rays(origins, unit(targets - origins), rows)


def _on_edges(setup: MeshSetup) -> tuple[Floats, Floats]:
    """Points on random edges, every fourth of them a vertex, and the centroid of a face of each edge."""
    rng = np.random.default_rng(SEED + 5)
    corners = setup.mesh.vertices[setup.mesh.faces[rng.integers(len(setup.mesh.faces), size=setup.count)]]
    each, start = np.arange(setup.count), rng.integers(3, size=setup.count)
    a, b = (corners[each, (start + k) % 3] for k in range(2))
    share = np.where(each % 4 == 0, 0.0, rng.random(setup.count))[:, None]
    return a + share * (b - a), corners.mean(axis=1)


def _first(setup: MeshSetup, rays: Rays) -> Known:
    found = _hits(setup, rays.origins[rays.rows], rays)
    return Known(found, np.ones(len(found), bool))


def _undoubted(setup: MeshSetup, rays: Rays, inward: Floats) -> Known:
    origins, directions = rays.origins[rays.rows], rays.directions[rays.rows]
    known = _hits(setup, origins, rays)
    # The coordinate axis with the smallest component is never parallel to the direction.
    u = np.cross(directions, np.eye(3)[np.abs(directions).argmin(axis=1)])
    turns = 2.0 * np.pi * np.arange(AROUND) / AROUND
    ways = [unit(inward), *(np.cos(turn) * unit(u) + np.sin(turn) * np.cross(directions, unit(u)) for turn in turns)]
    counts = np.ones(len(known), bool)
    for way in ways:
        counts &= _apart(known, _hits(setup, origins + ASIDE * setup.size * way, rays)) <= TOUCH * setup.size
    return Known(known, counts)


def _hits(setup: MeshSetup, origins: Floats, rays: Rays) -> Floats:
    return reference.first_hit(setup.mesh.vertices, setup.mesh.faces, origins, rays.directions[rays.rows]).t


def _apart(a: Floats, b: Floats) -> Floats:
    """Differences; 0 where both miss, inf where one does."""
    missed = np.isinf(a) & np.isinf(b)
    return np.abs(np.where(missed, 0.0, a) - np.where(missed, 0.0, b))


def _judge(setup: MeshSetup, rays: Rays, known: Callable[[], Known], answer: Any) -> Judgement:
    wanted, counts = known()
    errors = _apart(on_host(answer.t)[rays.rows], wanted)
    wrong = ~(errors <= ELSEWHERE * setup.size)
    # Wrong answers are drawn where the ray should have hit, or at its start if it should have missed.
    reach = np.where(np.isinf(wanted), 0.0, wanted)[:, None]
    positions = rays.origins[rays.rows] + reach * rays.directions[rays.rows]
    return judged(errors[counts], positions[counts], wrong[counts])
