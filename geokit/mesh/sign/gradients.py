"""Derivatives of winding numbers with respect to points and vertices.

Away from the surface the winding number changes only because the mesh has a border: the mesh and a fan of triangles
over its border edges form a closed surface together, whose winding number is whole. So the derivative is that of the
solid angles of the fan, and 0 for a closed mesh.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.gradients.library import Library, cross, dot, length
from geokit.core.gradients.rules import Asked, Rule

__all__ = ["WINDING_NUMBER", "border_edges"]

# Where the fan's apex lies, in the mesh's box: no plane through vertices of a simple shape passes there.
APEX = (0.4619, 0.5357, 0.5128)


def border_edges(faces: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Edges (E, 2) in which the faces do not cancel, and how often each is passed from its first vertex on (E,)."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forward = ends[:, 0] < ends[:, 1]
    edges, row = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    passes = np.bincount(row.ravel(), weights=np.where(forward, 1.0, -1.0), minlength=len(edges))
    some = (passes != 0.0) & (edges[:, 0] != edges[:, 1])
    return edges[some], passes[some]


def _wound(surface: Any, as_given: bool) -> NDArray[np.int32]:
    """The faces that count, wound as the winding number takes them."""
    if as_given:
        return np.asarray(surface.mesh.faces)
    deciding = surface._signs
    faces, flipped = deciding.mesh.faces, deciding._orientation.flipped
    return np.where(flipped[:, None], faces[:, ::-1], faces)


def _winding_number(library: Library, asked: Asked, answer: Any) -> tuple[Any, ...]:
    surface, points = asked.arguments["self"], asked.tensors["points"]
    edges, passes = border_edges(_wound(surface, asked.arguments["as_given"]))
    if not len(edges):
        return ((points * 0.0).sum(1),)
    vertices = asked.tensors.get("vertices")
    if vertices is None:
        vertices = library.constant(surface.mesh.vertices, points)
    low, high = surface.bounds
    apex = library.constant(low + np.array(APEX) * (high - low), points)
    ends = library.constant(edges, points)
    a, b = (library.take(vertices, ends[:, end])[None] - points[:, None] for end in (0, 1))
    c = (apex - points)[:, None] + a * 0.0
    la, lb, lc = (length(library, side) for side in (a, b, c))
    # Solid angle of a triangle: Van Oosterom and Strackee (1983).
    volume = dot(cross(library, a, b), c)
    below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    # Both are 0 on an edge of the border, where derivatives grow without bound: there they are left out.
    beside = (volume != 0.0) | (below != 0.0)
    volume, below = library.where(beside, volume, 0.0), library.where(beside, below, 1.0)
    angles = 2.0 * library.arctan2(volume, below)
    return ((angles * library.constant(passes, points)).sum(1) / (4.0 * math.pi),)


WINDING_NUMBER = Rule((True,), _winding_number, shapes=lambda asked: [((len(asked.tensors["points"]),), "float")])
