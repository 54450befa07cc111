"""Meshes made from another mesh by renumbering it: attributes and parts follow their vertices, faces and corners."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory.row_products import row_product
from geokit.mesh.model.data import Data, has_meaning
from geokit.mesh.model.triangle_mesh import MeshPart, TriangleMesh, trusted_mesh


def derived(
    mesh: TriangleMesh,
    vertices: NDArray[np.float64],
    faces: NDArray[Any],
    *,
    vertex_source: NDArray[Any] | None = None,
    face_source: NDArray[Any] | None = None,
    reversed_faces: NDArray[np.bool_] | None = None,
) -> TriangleMesh:
    """A mesh over new, valid arrays, with everything else that the given mesh has.

    Args:
        mesh: What the new mesh is made from.
        vertices: Positions [world], shape (V, 3), finite.
        faces: Vertex indices, shape (F, 3), in range; reversed already where ``reversed_faces`` says so.
        vertex_source: The vertex of ``mesh`` that each vertex comes from, (V,); None if they are the same.
        face_source: The face of ``mesh`` that each face comes from, (F,), ascending; None if they are the same.
        reversed_faces: Faces with their corners in reverse order, (F,); None if there are none.
    """
    more: dict[str, Any] = {name: getattr(mesh, name) for name in ("materials", "meters_per_unit", "up_axis")}
    more["vertex_data"] = _taken(mesh.vertex_data, vertex_source)
    more["face_data"] = _taken(mesh.face_data, face_source)
    corners = _taken(mesh.corner_data, face_source)
    if reversed_faces is not None:
        corners = {name: _reversed(values, reversed_faces) for name, values in corners.items()}
    more["corner_data"] = corners
    parts = mesh.parts if face_source is None else _parts(mesh.parts, face_source)
    return trusted_mesh(
        np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32), mesh.name, parts, more
    )


def used_vertices(faces: NDArray[Any], count: int) -> tuple[NDArray[np.int64], NDArray[Any]]:
    """The vertices of ``count`` that faces use (U,), ascending, and the faces as rows of these (F, 3)."""
    if 8 * faces.size < count:
        # A small piece of a large mesh: a mark for each vertex would take longer.
        used, corners = np.unique(faces, return_inverse=True)
        return used, corners.reshape(faces.shape)
    is_used = np.zeros(count, bool)
    is_used[faces.reshape(-1)] = True
    return np.flatnonzero(is_used), np.take(np.cumsum(is_used) - 1, faces)


def with_data(mesh: TriangleMesh, **data: Any) -> TriangleMesh:
    """The same mesh with other, valid data: ``vertex_data``, ``face_data``, ``corner_data``, ``materials``, ..."""
    kept = ("vertex_data", "face_data", "corner_data", "materials", "meters_per_unit", "up_axis")
    more = {name: data.get(name, getattr(mesh, name)) for name in kept}
    return trusted_mesh(mesh.vertices, mesh.faces, mesh.name, mesh.parts, more)


def moved_to_corners(mesh: TriangleMesh, kept: NDArray[np.int64], group: NDArray[np.int64]) -> TriangleMesh:
    """The mesh with those vertex attributes on its corners in which vertices that will be merged differ.

    Args:
        mesh: The mesh before vertices are merged.
        kept: The vertex that stays of each group (G,).
        group: The group of each vertex (V,).
    """
    first = kept[group]
    # An attribute that corners have already covers that of vertices.
    differ = [
        name
        for name, values in mesh.vertex_data.items()
        if name not in mesh.corner_data and not np.array_equal(_bits(values[first]), _bits(values))
    ]
    if not differ:
        return mesh
    corners = {name: mesh.vertex_data[name][mesh.faces] for name in differ}
    rest = {name: values for name, values in mesh.vertex_data.items() if name not in differ}
    return with_data(mesh, vertex_data=rest, corner_data={**mesh.corner_data, **corners})


def turned_normals(data: Data, linear: NDArray[np.float64], axes: int = 1) -> Data:
    """The data with its normals turned by a linear map of positions; their lengths stay.

    Args:
        data: Arrays by name.
        linear: Matrix (3, 3) for column vectors; it may mirror, and may be singular.
        axes: 2 for data on corners.
    """
    normal = data.get("normal")
    if normal is None or not has_meaning("normal", normal, axes):
        return data
    # Scaled, so that products neither overflow nor underflow.
    u, v, w = (linear / (np.abs(linear).max() or 1.0)).T
    # The inverse transpose times the determinant, which a flat map also has; mirrored, normals stay outside.
    cofactors = np.stack([np.cross(v, w), np.cross(w, u), np.cross(u, v)], axis=1)
    cofactors *= -1.0 if np.dot(u, cofactors[:, 0]) < 0.0 else 1.0
    wide = normal.astype(np.float64)
    turned = row_product(wide, cofactors.T)
    before, after = (np.linalg.norm(vectors, axis=-1, keepdims=True) for vectors in (wide, turned))
    turned *= np.divide(before, after, out=np.ones_like(after), where=after != 0.0)
    return {**data, "normal": turned.astype(normal.dtype)}


def _taken(data: Data, source: NDArray[Any] | None) -> Data:
    return data if source is None or not data else {name: values[source] for name, values in data.items()}


def _reversed(values: NDArray[Any], rows: NDArray[np.bool_]) -> NDArray[Any]:
    values = values.copy()
    values[rows] = values[rows, ::-1]
    return values


def _bits(values: NDArray[Any]) -> NDArray[Any]:
    # As bytes, NaN equals NaN.
    return np.ascontiguousarray(values).reshape(-1).view(np.uint8)


def _parts(parts: tuple[MeshPart, ...], source: NDArray[Any]) -> tuple[MeshPart, ...]:
    """The parts with the face ranges that remain of them."""
    ends = [np.searchsorted(source, (part.first_face, part.first_face + part.face_count)) for part in parts]
    return tuple(MeshPart(p.name, int(a), int(b - a)) for p, (a, b) in zip(parts, ends, strict=True))
