"""Charts of closest points (cost of exactness, gain from a radius), and of signs, on the mesh and on damaged copies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.charts.mesh_setup import SOLID_ANGLE, Queries
from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import held_bytes, judged, on_host, send, setting_of
from geokit.core.base.late_warp import wp
from geokit.mesh.model.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from geokit.accuracy.charts.mesh_setup import MeshSetup
    from geokit.mesh.surfaces.surface import Surface

# Search radii [diagonals].
RADII = (0.1, 0.01)
# Distances closer to the search radius than this [diagonals] may count as within or beyond it.
BORDER = 1e-9
# Memory of warp's tree for each triangle [bytes], from docs/kernels.md.
WARP_TREE = 100

METHODS = ("auto", "pseudonormal", "parity", "winding")
# Points closer to the surface than this [diagonals] are neither inside nor outside.
ON_SURFACE = 1e-9
# On an open mesh, points with a winding number closer to 1/2 than this may count as either.
AMBIGUOUS = 0.1
# Share of the area removed by a hole, and of the faces that are flipped or doubled.
HOLE = 0.03
FLIPPED = 0.1
DOUBLED = 0.1
DAMAGES = {"hole": "with a hole", "flips": "with turned faces", "doubles": "with doubled faces"}


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


def sign_charts(setup: MeshSetup) -> list[Chart]:
    """Shares of wrong signs: on the mesh as it is, and with a hole, with flipped faces and with doubled faces.

    Each kind of damage has a chart of its own, because methods react differently to each. Inside is where the winding
    number of the undamaged mesh, with faces wound outward, exceeds one half; damaged meshes are compared with the
    undamaged one. Half of the points are near the surface. Points on the surface, and points of an open mesh with a
    winding number near one half, are left out.
    """
    title, judge = "Inside or outside", _judge_signs(setup)
    return [
        Chart("sign", title, "relative", "queries", lambda: _sign_trials(setup, setup.surface, judge), "wrong"),
        *(
            Chart(
                f"sign_{damage}",
                f"{title} of the mesh {what}",
                "relative",
                "queries",
                partial(_broken, setup, damage, judge),
                "wrong",
            )
            for damage, what in DAMAGES.items()
            if not (setup.quick and damage == "doubles")
        ),
    ]


def damaged(mesh: TriangleMesh, damage: str, seed: int = 0) -> TriangleMesh:
    """The mesh with one hole of 3% of its area, or with a tenth of its faces flipped or doubled.

    Args:
        mesh: The triangles.
        damage: "hole", "flips" or "doubles".
        seed: Seed of the choice of faces.
    """
    rng, faces = np.random.default_rng(seed), mesh.faces
    if damage == "flips":
        some = rng.permutation(len(faces))[: int(np.ceil(FLIPPED * len(faces)))]
        faces = faces.copy()
        faces[some] = faces[some, ::-1]
    elif damage == "doubles":
        some = rng.permutation(len(faces))[: int(np.ceil(DOUBLED * len(faces)))]
        faces = np.concatenate([faces, faces[some]])
    else:
        corners = mesh.vertices[faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        middle = corners.mean(axis=1)
        order = np.argsort(np.linalg.norm(middle - middle[rng.integers(len(faces))], axis=1), kind="stable")
        gone = np.searchsorted(np.cumsum(area[order]), HOLE * area.sum()) + 1
        faces = faces[np.sort(order[gone:])]
    return TriangleMesh(mesh.vertices, faces, name=f"{mesh.name}, {damage}")


def _broken(setup: MeshSetup, damage: str, judge: Callable[[Any], Judgement]) -> Iterator[Trial]:
    from geokit.mesh.surfaces.surface import Surface

    mesh = damaged(setup.mesh, damage)
    if len(mesh.faces):
        yield from _sign_trials(setup, Surface(mesh, device=setup.device), judge)


def _sign_trials(setup: MeshSetup, surface: Surface, judge: Callable[[Any], Judgement]) -> Iterator[Trial]:
    points = send(setup.mixed().points, setup.device)
    for method in METHODS:
        chosen = {"sign": method}
        run = partial(surface.contains, points, sign=method)
        yield Trial(f"contains, {method}", setting_of(chosen), run, judge, setup.count, held_bytes(surface), chosen)


def _judge_signs(setup: MeshSetup) -> Callable[[Any], Judgement]:
    @cache
    def known() -> tuple[Queries, NDArray[np.bool_]]:
        """The checked points that count, and which of them are inside."""
        mesh, queries = setup.oriented, setup.mixed(SOLID_ANGLE)
        at, rows = queries.checked, queries.rows
        winding = reference.winding_number(mesh.vertices, mesh.faces, at)
        counts = reference.closest_point(mesh.vertices, mesh.faces, at).distance > ON_SURFACE * setup.size
        if not setup.is_closed:
            counts &= np.abs(winding - 0.5) > AMBIGUOUS
        return Queries(at[counts], rows[counts]), winding[counts] > 0.5

    def judge(answer: Any) -> Judgement:
        (at, rows), inside = known()
        return judged(np.zeros(len(at)), at, (on_host(answer)[rows] != 0.0) != inside)

    return judge
