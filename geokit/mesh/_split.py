"""Pieces of a mesh: connected components, named parts, faces of one material."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geokit.core.interop.types import MeshLike
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import require_choice, require_count
from geokit.errors import InputError
from geokit.mesh.attributes.derived import derived, used_vertices
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.topology.audit import face_parts
from geokit.mesh.topology.measures import measure_faces

KINDS = ("components", "parts", "materials")


@needs(lambda mesh, **_: 120 * mesh.face_count, late=True)
def split(mesh: MeshLike, *, by: str = "components") -> list[TriangleMesh]:
    """Split a mesh into pieces, each with the vertices that its faces use and with its attributes.

    - "components": faces that share a vertex position with each other, as in :func:`geokit.mesh.audit`, in the order of
      their first faces. A cavity is a component of its own.
    - "parts": the named ranges of ``mesh.parts``, without empty ones. Faces in none of them are left out; a mesh
      without parts is one piece.
    - "materials": the faces of each row of ``mesh.materials``, then those without one.

    Args:
        mesh: The mesh; it may be empty.
        by: "components", "parts" or "materials".
    Returns:
        The pieces. They are called after parts and materials; components are called after the mesh.
    Raises:
        InputError: mesh is not a TriangleMesh, or ``by`` is none of these.
    Example:
        >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [1, 0, 5], [0, 1, 5]]
        >>> two = gk.mesh.TriangleMesh(corners, [[0, 1, 2], [3, 4, 5]], name="two")
        >>> gk.mesh.split(two)
        [TriangleMesh('two', 3 vertices, 1 faces), TriangleMesh('two', 3 vertices, 1 faces)]
    """
    mesh = require_mesh(mesh, "mesh")
    require_choice(by, "by", KINDS)
    if by == "parts" and mesh.parts:
        ranges = [(part.name, np.arange(part.first_face, part.first_face + part.face_count)) for part in mesh.parts]
        return [_piece(mesh, rows, name) for name, rows in ranges if len(rows)]
    if by == "materials" and mesh.materials:
        numbers = mesh.face_data.get("material", np.full(mesh.face_count, -1))
        names = [material.name for material in mesh.materials]
        groups = [(name, np.flatnonzero(numbers == number)) for number, name in enumerate(names)]
        return [_piece(mesh, rows, name) for name, rows in [*groups, ("", np.flatnonzero(numbers < 0))] if len(rows)]
    if by != "components":
        return [mesh] if mesh.face_count else []
    return [_piece(mesh, rows, mesh.name) for rows in _components(mesh)]


@needs(lambda mesh, *_, **__: 90 * mesh.face_count)
def keep_largest(mesh: MeshLike, count: int = 1, *, share: float | None = None) -> TriangleMesh:
    """Keep the connected components with the largest area, such as a part without the crumbs around it.

    Components are those of :func:`split`. A cavity is one as well: the largest component of a hollow body is its outer
    side alone. Of equal ones the first stay. Faces keep their order, their parts and all attributes; vertices that no
    remaining face uses are removed.

    Args:
        mesh: The mesh; it may be empty.
        count: How many components to keep, at most.
        share: Keep all components with at least this share of the largest one's area, from 0 to 1, whatever ``count``
            is.
    Returns:
        TriangleMesh.
    Raises:
        InputError: mesh is not a TriangleMesh, count is not a whole number from 1 up, or share is not from 0 to 1.
    Example:
        >>> bracket = gk.mesh.load("data/samples/bracket.obj")
        >>> gk.mesh.keep_largest(bracket).face_count == bracket.face_count
        True
    """
    mesh = require_mesh(mesh, "mesh")
    require_count(count, "count", 1)
    if share is not None and not 0.0 <= (share := require_finite_scalar(share, "share")) <= 1.0:
        raise InputError(f"share: {share:g} is not from 0 to 1; give a share of the largest component's area")
    components = _components(mesh)
    if len(components) <= 1:
        return mesh
    areas = measure_faces(mesh, mesh.bounds).twice_area
    sums = np.array([areas[rows].sum() for rows in components])
    largest = np.argsort(-sums, kind="stable")[:count]
    kept = largest if share is None else np.flatnonzero(sums >= share * sums.max())
    if len(kept) == len(components):
        return mesh
    return _piece(mesh, np.sort(np.concatenate([components[at] for at in kept])), mesh.name, keep_parts=True)


def _components(mesh: TriangleMesh) -> list[NDArray[np.int64]]:
    """The faces of each component, ascending, in the order of their first faces."""
    if not mesh.face_count:
        return []
    label = face_parts(mesh)
    order = np.argsort(label, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
    return sorted(groups, key=lambda rows: int(rows[0]))


def _piece(mesh: TriangleMesh, rows: NDArray[np.int64], name: str, *, keep_parts: bool = False) -> TriangleMesh:
    used, faces = used_vertices(mesh.faces[rows], mesh.vertex_count)
    piece = derived(mesh, mesh.vertices[used], faces, vertex_source=used, face_source=rows)
    if not keep_parts:
        piece.__dict__.update(name=name, parts=())
    return piece
