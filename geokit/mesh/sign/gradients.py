"""Derivatives of winding numbers with respect to points and vertices.

Away from the surface the winding number changes only because the mesh has a border. Where an edge of it moves, the
solid angle changes by the flux of r / |r|^3 through what the edge sweeps: with corners a and b as seen from the point,
by ``cross(b, a) / (|a| |b| + dot(a, b))``, divided by |a| for a move of a and by |b| for one of b. The slope of the
point is that of all corners, the other way; of a closed mesh it is 0.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from geokit.core.gradients.library import Library, cross, dot, length
from geokit.core.gradients.rules import Asked, Rule

# Parts of the points, each of which a thread adds for one edge; fewer where there are more edges than this is worth.
MOST_PARTS = 1024
MOST_THREADS = 1 << 18


def border_edges(faces: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Edges (E, 2) in which the faces do not cancel, and how often each is passed from its first vertex on (E,)."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forward = ends[:, 0] < ends[:, 1]
    edges, row = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    passes = np.bincount(row.ravel(), weights=np.where(forward, 1.0, -1.0), minlength=len(edges))
    some = (passes != 0.0) & (edges[:, 0] != edges[:, 1])
    return edges[some], passes[some]


def _border(asked: Asked) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The border of the faces that count, wound as the winding number takes them; passes are divided by 4 pi."""
    surface = asked.arguments["self"]
    if asked.arguments["as_given"]:
        faces = np.asarray(surface.mesh.faces)
    else:
        deciding = surface._signs
        faces = np.where(deciding._orientation.flipped[:, None], deciding.mesh.faces[:, ::-1], deciding.mesh.faces)
    edges, passes = border_edges(faces)
    return edges, passes / (4.0 * math.pi)


def _pull(library: Library, asked: Asked, answer: Any, slopes: Any) -> dict[str, Any]:
    points, slope = (library.wide(rows) for rows in (asked.tensors["points"], slopes[0]))
    edges, passes = (library.constant(part, points) for part in _border(asked))
    held = asked.tensors.get("vertices")
    vertices = library.constant(asked.arguments["self"].mesh.vertices, points) if held is None else library.wide(held)
    if not len(edges):
        return {"points": points * 0.0, "vertices": vertices * 0.0}
    a, b = (library.take(vertices, edges[:, end])[None] - points[:, None] for end in (0, 1))
    normal, along, la, lb = cross(library, b - a, a), dot(a, b), length(library, a), length(library, b)
    square = dot(normal, normal)
    # On the line of an edge there is no slope, or on the edge itself none that is bounded.
    some, is_beside = square > 0.0, along < 0.0
    below = library.where(some & ~is_beside, la * lb + along, 1.0)
    # Without the difference of two that are nearly equal.
    share = library.where(is_beside, (la * lb - along) / library.where(some & is_beside, square, 1.0), 1.0 / below)
    share = library.where(some, share, 0.0) * passes * slope[:, None]
    of_ends = [(share / library.where(some, far, 1.0))[..., None] * normal for far in (la, lb)]
    found = {"points": -(of_ends[0] + of_ends[1]).sum(1)}
    if held is not None:
        by_end = (library.add(part.sum(0), edges[:, end], len(vertices)) for end, part in enumerate(of_ends))
        found["vertices"] = sum(by_end)
    return found


def _adjoint(asked: Asked, answer: Any, slopes: Any, wanted: list[str], arrays: Any) -> dict[str, Any] | None:
    """The same by kernels: a thread for each point, and for each edge and part of the points."""
    from geokit.mesh.sign.border_slopes_kernels import POINT_SLOPES, VERTEX_SLOPES

    surface, count = asked.arguments["self"], len(asked.tensors["points"])
    if arrays.device != surface._device or slopes[0] is None:
        return None

    def uploaded() -> Any:
        given = zip(_border(asked), (wp.vec2i, wp.float64), strict=True)
        return [wp.array(part, dtype=kind, device=arrays.device) for part, kind in given]

    edges, passes = surface._cache.find(("border", asked.arguments["as_given"]), uploaded)
    given = [arrays.given(asked.tensors["points"], 3), surface._vertices, edges, passes, arrays.given(slopes[0])]
    found = {}
    if "points" in wanted:
        found["points"] = arrays.made(count, 3)
        arrays.launch(POINT_SLOPES[arrays.number], count, given, [found["points"]])
    if "vertices" in wanted:
        parts = max(1, min(MOST_PARTS, count, MOST_THREADS // max(1, len(edges))))
        out = arrays.made(2 * parts * len(edges), 3, wp.float64), arrays.made(2 * parts * len(edges), 1, wp.int32)
        arrays.launch(VERTEX_SLOPES[arrays.number], parts * len(edges), [parts, *given], out)
        found["vertices"] = arrays.added(*out, len(asked.tensors["vertices"]))
    return found


WINDING_NUMBER = Rule(
    (True,), pull=_pull, adjoint=_adjoint, shapes=lambda asked: [((len(asked.tensors["points"]),), "float")]
)
