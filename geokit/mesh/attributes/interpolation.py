"""Attributes at points of triangles: interpolated by barycentric weights, or of the nearest corner."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.require import require_items, require_text
from geokit.errors import InputError
from geokit.mesh.model.data import has_meaning
from geokit.mesh.model.triangle_mesh import TriangleMesh

# Weights below this are rounding of points at a corner or on an edge.
ROUNDING = 1e-12


def chosen_names(mesh: TriangleMesh, names: Any) -> list[str]:
    """The names of a mesh's attributes, or those of them that were asked for.

    Raises:
        InputError: ``names`` is no list of names that the mesh has.
    """
    known = list(dict.fromkeys([*mesh.vertex_data, *mesh.face_data, *mesh.corner_data]))
    if names is None:
        return known
    asked: list[str] = require_items(names, "names", str)
    for name in asked:
        if require_text(name, "names") not in known:
            listed = ", ".join(map(repr, known)) or "none"
            raise InputError(f"names: {mesh.name or 'the mesh'} has no {name!r}; it has {listed}")
    return asked


def interpolation_bytes(mesh: TriangleMesh, names: Collection[str] | None = None) -> int:
    """What :func:`interpolated` takes for each point, with closest points: by the widest attribute, and all answers."""
    widths = [
        values[0].size // (3 if data is mesh.corner_data else 1)
        for data in (mesh.vertex_data, mesh.corner_data)
        for name, values in data.items()
        if len(values) and (names is None or name in names)
    ]
    return 92 + 96 * max(widths, default=0) + 8 * sum(widths)


def interpolated(
    mesh: TriangleMesh, triangle_id: NDArray[Any], barycentric: NDArray[np.float64], names: Collection[str]
) -> dict[str, NDArray[Any]]:
    """Attributes at points of triangles, each in its type. Of one name, corners win over vertices over faces.

    Floats and colors are interpolated in float64 and rounded once, normals get unit length. Other integers and bools
    are those of the corner with the largest weight. Misses are NaN, 0 in integers, and -1 in ``material``.

    Args:
        mesh: The mesh.
        triangle_id: Its faces, (N,); -1 is a miss.
        barycentric: Weights of their corners, (N, 3).
        names: The attributes.
    """
    missed = triangle_id < 0
    rows = np.where(missed, 0, triangle_id)
    found = {}
    for name in names:
        if name in mesh.corner_data:
            values = mesh.corner_data[name][rows]
        elif name in mesh.vertex_data:
            values = mesh.vertex_data[name][mesh.faces[rows]]
        else:
            values = mesh.face_data[name][rows]
        if name in mesh.corner_data or name in mesh.vertex_data:
            values = _blended(name, values, barycentric)
        if missed.any():
            values = values.copy()
            values[missed] = np.nan if values.dtype.kind == "f" else -1 if name == "material" else 0
        found[name] = values
    return found


def _blended(name: str, values: NDArray[Any], weights: NDArray[np.float64]) -> NDArray[Any]:
    """One row of the three, (N, 3) or (N, 3, k)."""
    dtype = values.dtype
    if dtype.kind != "f" and not has_meaning(name, values, 2):
        return values[np.arange(len(values)), np.argmax(weights, axis=1)]
    table = (values if values.ndim == 3 else values[..., None]).astype(np.float64)
    # A corner without weight must not matter, also where its value is NaN.
    terms = np.where(weights[..., None] == 0.0, 0.0, table * weights[..., None])
    blended = (terms[:, 0] + terms[:, 1]) + terms[:, 2]
    if has_meaning(name, values, 2) and name == "normal":
        length = np.linalg.norm(blended, axis=1, keepdims=True)
        blended = np.divide(blended, length, out=blended, where=length > 0.0)
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        blended = np.clip(np.rint(blended), limits.min, limits.max)
    return (blended if values.ndim == 3 else blended[:, 0]).astype(dtype)


def weights_within(corners: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights of the corners of triangles (N, 3, 3) at points (N, 3), taken along the normals and kept within.

    A triangle without area has weights of its first corner.
    """
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    ap, normal = points - a, np.cross(ab, ac)
    squared = np.einsum("ij,ij->i", normal, normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        w = np.stack([np.cross(ap, ac), np.cross(ab, ap)], axis=1) @ normal[..., None] / squared[:, None, None]
    w = np.where((squared > 0.0)[:, None], w[..., 0], 0.0)
    weights = np.column_stack([1.0 - w[:, 0] - w[:, 1], w])
    weights[weights < ROUNDING] = 0.0
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def closest_weights(
    corners: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights of the corners of triangles (N, 3, 3) at the points closest to points (N, 3), and the distances (N,)."""
    choices = [weights_within(corners, points)]
    for corner in range(3):
        start, edge = corners[:, corner], corners[:, (corner + 1) % 3] - corners[:, corner]
        squared = np.einsum("ij,ij->i", edge, edge)
        along = np.einsum("ij,ij->i", points - start, edge)
        share = np.clip(np.divide(along, squared, out=np.zeros_like(along), where=squared > 0.0), 0.0, 1.0)
        weights = np.zeros((len(points), 3))
        weights[:, corner], weights[:, (corner + 1) % 3] = 1.0 - share, share
        choices.append(weights)
    weights = np.stack(choices)
    distance = np.linalg.norm(np.einsum("knc,nci->kni", weights, corners) - points, axis=2)
    best = distance.argmin(axis=0), np.arange(len(points))
    return weights[best], distance[best]
