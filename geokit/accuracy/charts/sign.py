"""Charts of signs: wrong inside/outside answers by method, on the mesh and on damaged copies."""

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
from geokit.mesh.model.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from geokit.accuracy.charts.mesh_setup import MeshSetup
    from geokit.mesh.surfaces.surface import Surface

__all__ = ["DAMAGES", "damaged", "sign_charts"]

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


def sign_charts(setup: MeshSetup) -> list[Chart]:
    """Shares of wrong signs: on the mesh as it is, and with a hole, with flipped faces and with doubled faces.

    Each kind of damage has a chart of its own, because methods react differently to each. Inside is where the winding
    number of the undamaged mesh, with faces wound outward, exceeds one half; damaged meshes are compared with the
    undamaged one. Half of the points are near the surface. Points on the surface, and points of an open mesh with a
    winding number near one half, are left out.
    """
    title, judge = "Inside or outside", _judge(setup)
    return [
        Chart("sign", title, "relative", "queries", lambda: _trials(setup, setup.surface, judge), "wrong"),
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
        yield from _trials(setup, Surface(mesh, device=setup.device), judge)


def _trials(setup: MeshSetup, surface: Surface, judge: Callable[[Any], Judgement]) -> Iterator[Trial]:
    points = send(setup.mixed().points, setup.device)
    for method in METHODS:
        chosen = {"sign": method}
        run = partial(surface.contains, points, sign=method)
        yield Trial(f"contains, {method}", setting_of(chosen), run, judge, setup.count, held_bytes(surface), chosen)


def _judge(setup: MeshSetup) -> Callable[[Any], Judgement]:
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
