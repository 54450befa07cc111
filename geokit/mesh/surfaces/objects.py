"""Meshes of other libraries as a TriangleMesh; geokit.core.interop.objects finds their arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.gradients.rules import is_warp_array
from geokit.core.interop.objects import Polygons, attribute, getattr_or_none, points_of, polygons_of
from geokit.core.memory.needs import needs
from geokit.core.require import read_array
from geokit.errors import InputError
from geokit.formats.attributes.joined import JoinedData
from geokit.formats.file_content.body import Body
from geokit.formats.objects import carried_by
from geokit.formats.polygons import triangulate
from geokit.mesh.model.triangle_mesh import TriangleMesh


@needs()
def as_mesh(mesh: Any) -> TriangleMesh:
    """The TriangleMesh of a mesh of another library, as all functions of geokit that take a mesh make it.

    Meshes are told by what they hold: ``vertices`` and ``faces`` (trimesh, and most others) or ``triangles`` (Open3D,
    also its tensors), ``points`` and ``faces`` (pyvista's PolyData), ``points`` and ``cells`` (meshio); a scene of
    trimesh is joined. A pair (vertices, faces) of arrays of any library is a mesh too. Polygons are split into
    triangles as those of files are. Float64 coordinates are kept to the last bit. None of the libraries is imported.

    Attributes come along: arrays on vertices and faces, normals, texture coordinates, colors, materials with the image
    of their base color, trimesh's unit and name. A UserWarning names what is left out: lines, points and cells of
    volumes beside the faces, and attributes that cannot be read. Functions that only answer questions about the
    geometry, and ``Surface``, take the materials without the images.

    Args:
        mesh: A mesh, or a pair (vertices (V, 3), faces (F, K)). A TriangleMesh is returned as it is.
    Returns:
        TriangleMesh.
    Raises:
        InputError: It is no mesh, or its arrays are not those of one; see :class:`TriangleMesh`.
    Example:
        >>> as_mesh(([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2, 3]]))
        TriangleMesh(4 vertices, 2 faces)
    """
    return require_mesh(mesh, "mesh")


def require_mesh(mesh: Any, name: str, *, images: bool = True) -> TriangleMesh:
    """Return a TriangleMesh, also of a mesh of another library; see :func:`as_mesh`.

    Functions that answer questions about the geometry leave the images of its materials out.

    Raises:
        InputError: ``mesh`` is no mesh, or its arrays are not those of one.
    """
    if isinstance(mesh, TriangleMesh):
        return mesh
    found = polygons_of(mesh, name)
    if found is None:
        remedy = "make one from vertices and faces"
        if hasattr(mesh, "extract_surface"):
            remedy = "give its surface, mesh.extract_surface()"
        kind = type(mesh).__module__.partition(".")[0]
        whose = "" if kind in ("builtins", "geokit", "numpy") else f"{kind}'s "
        # Open3D's tensor meshes have no positions while they are empty.
        what = "is not a TriangleMesh" if type(mesh).__name__ != "TriangleMesh" else "has no vertices and faces"
        raise InputError(f"{name}: {whose}{type(mesh).__name__} {what}; {remedy}")
    try:
        vertices = _vertices(found.points, name)
        faces, polygon = found.faces, None
        if faces is None or (faces.ndim == 2 and faces.shape[1] > 3):
            faces, polygon = _triangles(vertices, *_polygons(faces, found.counts, found.indices))
        more = {} if found.source is None else _carried(found, vertices, faces, polygon, name, images)
        return TriangleMesh(vertices, faces, **more)
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(name) else f"{name}.{message}") from error


def _carried(
    found: Polygons,
    vertices: NDArray[np.float64],
    faces: NDArray[Any],
    polygon: NDArray[np.int64] | None,
    name: str,
    images: bool,
) -> dict[str, Any]:
    """Arguments of the mesh for what the object carries; ``polygon`` is that of each triangle, None if the same."""
    if faces.ndim != 2 or faces.shape[1] != 3:  # refused by the mesh itself
        return {}
    counts = np.full(len(faces), 3) if polygon is None else np.bincount(polygon) + 2
    body = carried_by(found.source, Body(vertices, counts, np.broadcast_to(0, int(counts.sum()))), images=images)
    # Without faces the mesh is refused by what asks for them.
    body = body._replace(notes=(*(found.notes if len(faces) else ()), *body.notes))
    data = JoinedData()
    # Only Open3D's meshes, which are triangles, have data on corners.
    data.add(body, np.arange(len(faces)) if polygon is None else polygon, None, reverse=False)
    title = (attribute(found.source, "metadata") or {}).get("name") if hasattr(found.source, "visual") else None
    return {**data.arguments(Path(name)), **({"name": title} if isinstance(title, str) else {})}


def _vertices(points: Any, name: str) -> NDArray[np.float64]:
    from geokit.core.interop.user_arrays import read_numbers

    # Those of warp are refused where a tape is recording.
    if getattr_or_none(points, "requires_grad") is True and not is_warp_array(points):
        raise InputError("vertices: require gradients, not recorded here; geokit.torch records them, or detach() them")
    return read_numbers(points_of(points, name), "vertices")


def _polygons(faces: NDArray[Any] | None, counts: Any, indices: Any) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    if faces is not None:
        counts, indices = np.full(len(faces), faces.shape[1]), faces.ravel()
    if len(indices) and np.asarray(indices).dtype.kind not in "iu":
        raise InputError(f"faces: dtype {np.asarray(indices).dtype} is not an integer type; convert the indices")
    return np.asarray(counts, np.int64), np.asarray(indices).astype(np.int64)


def _triangles(
    vertices: NDArray[np.float64], counts: NDArray[np.int64], indices: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    few = counts < 3
    if few.any():
        row = int(np.argmax(few))
        raise InputError(f"faces: row {row} has {counts[row]} corners; a face needs three or more, remove it")
    outside = (indices < 0) | (indices >= len(vertices))
    if outside.any():
        corner = int(np.argmax(outside))
        row = int(np.searchsorted(np.cumsum(counts), corner, side="right"))
        raise InputError(f"faces: row {row} uses vertex {indices[corner]} of {len(vertices)}; indices count from 0")
    return triangulate(read_array(vertices, "vertices", np.float64), counts, indices)
