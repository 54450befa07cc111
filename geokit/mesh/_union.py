"""Unions of meshes: what several closed bodies enclose together."""

from __future__ import annotations

from typing import Any

import numpy as np

from geokit.core.interop.types import MeshLike
from geokit.core.memory.needs import needs
from geokit.core.require import require_one_world
from geokit.errors import InputError
from geokit.mesh.attributes.derived import derived
from geokit.mesh.model.triangle_mesh import MeshPart, TriangleMesh, trusted_mesh
from geokit.mesh.surfaces.objects import require_mesh

__all__ = ["union"]

# For each face: its tree, its topology, and manifold3d's solids before and after.
BYTES_PER_FACE = 920


def _bytes(mesh: TriangleMesh, *others: TriangleMesh, **_: Any) -> float:
    return BYTES_PER_FACE * sum(each.face_count for each in (mesh, *others))


@needs(_bytes, late=True)
def union(mesh: MeshLike, *others: MeshLike) -> TriangleMesh:
    """The boundary of what the closed bodies of one or several meshes enclose together.

    Surface that has the solid on both sides is removed: walls between bodies that touch or overlap, bodies within
    others, and open sheets inside of a body. Cavities stay, and so do open sheets that do not lie inside of a body as a
    whole. Bodies are found by their edges, also where several of them share an edge, a face, or a wall that is there
    once. Faces are wound as by :func:`geokit.mesh.orient` first.

    The union is exact but for the rounding of new vertices (manifold3d). Bodies that touch but for rounding, up to 1e-6
    of the mesh's size apart, grow by as much as joins them, at most 1e-6 of the size. The result is compared with
    winding numbers of the bodies on both sides of its faces.

    Bodies that no other one comes near keep their faces as they are. The faces of one mesh keep their attributes and
    parts; vertices and corners lose theirs. Of several meshes each is a part of the result, without attributes. Of
    faces that lie back to back one is left. One mesh with nothing to remove and nothing to turn is returned as it is.

    Args:
        mesh: Triangles; it may be empty.
        others: Further meshes, in the same unit and with the same axis up, if they say any.
    Returns:
        TriangleMesh with the name of the first one.
    Raises:
        InputError: An argument is no mesh, units or axes differ, more than 0.1% of the surface of a body lies inside of
            that body itself, whole triangles with more than 0.1% of the area of sheets that reach out of a body lie
            inside of it, or the union cannot be made; the message says why.
        MissingDependencyError: manifold3d is not installed.
        DeviceMemoryError: There is not enough memory.
    Source:
        Manifold, by Lalish et al.; winding numbers: Barill et al. (2018).
    Example:
        >>> low, high = gk.mesh.box(), gk.mesh.box(center=(0, 0, 1))
        >>> both = gk.mesh.union(low, high)
        >>> both.area, both.volume
        (10.0, 2.0)
    """
    from geokit.mesh.solids.boundary import boundary_of
    from geokit.mesh.surfaces.surface import Surface

    if isinstance(mesh, (list, tuple)) and mesh and all(isinstance(one, TriangleMesh) for one in mesh):
        raise InputError(f"mesh: a {type(mesh).__name__} of meshes; give each of them: union(*meshes)")
    meshes = [require_mesh(mesh, "mesh")]
    meshes += [require_mesh(other, f"others[{number}]") for number, other in enumerate(others)]
    joined = _joined(meshes)
    if not joined.face_count:
        return joined
    surface = Surface(joined, device="cpu")
    boundary = boundary_of(surface)
    if boundary.kept:
        raise InputError(
            f"{joined.name or 'mesh'}: its union is not right: {boundary.kept}; repair the bodies one by one, such as "
            "with merge_vertices and orient"
        )
    return boundary.mesh if boundary.source is not None else _as_counted(surface)


def _as_counted(surface: Any) -> TriangleMesh:
    """The mesh without the second of faces back to back, and with solids outward."""
    from geokit.mesh.sign.left_out import left_out_faces

    mesh: TriangleMesh = surface.mesh
    source = np.arange(mesh.face_count)
    if surface._counted is not surface:
        source = np.delete(source, left_out_faces(surface))
    flipped = surface._counted._orientation.flipped
    if len(source) == mesh.face_count and not flipped.any():
        return mesh
    faces = np.where(flipped[:, None], mesh.faces[source, ::-1], mesh.faces[source])
    used, corners = np.unique(faces, return_inverse=True)
    return derived(
        mesh, mesh.vertices[used], corners.reshape(-1, 3), vertex_source=used, face_source=source,
        reversed_faces=flipped,
    )  # fmt: skip


def _joined(meshes: list[TriangleMesh]) -> TriangleMesh:
    """One mesh of all of them, each with its vertices and as a part."""
    if len(meshes) == 1:
        return meshes[0]
    first, *others = meshes
    said = require_one_world(mesh=first, **{f"others[{number}]": other for number, other in enumerate(others)})
    vertex_ends = np.cumsum([mesh.vertex_count for mesh in meshes])
    face_ends = np.cumsum([mesh.face_count for mesh in meshes])
    if vertex_ends[-1] > np.iinfo(np.int32).max:
        raise InputError(f"others: {vertex_ends[-1]} vertices together are more than a mesh can have")
    begins = vertex_ends - [mesh.vertex_count for mesh in meshes]
    return trusted_mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + np.int32(begin) for mesh, begin in zip(meshes, begins, strict=True)]),
        meshes[0].name,
        tuple(
            MeshPart(mesh.name or str(number), int(end) - mesh.face_count, mesh.face_count)
            for number, (mesh, end) in enumerate(zip(meshes, face_ends, strict=True))
        ),
        said,
    )
