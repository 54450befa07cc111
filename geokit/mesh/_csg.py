"""Unions, differences and intersections of meshes: what closed bodies enclose together, alone, or in common."""

from __future__ import annotations

from itertools import accumulate
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core.interop.types import MeshLike
from geokit.core.memory.needs import needs
from geokit.core.require import require_one_world
from geokit.errors import InputError
from geokit.mesh.attributes.derived import derived, with_data
from geokit.mesh.model.triangle_mesh import MeshPart, TriangleMesh, trusted_mesh
from geokit.mesh.surfaces.objects import require_mesh

if TYPE_CHECKING:
    from geokit.mesh.solids.pieces import Verb

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
    parts; vertices and corners lose theirs. Of several meshes each is a part of the result, with the attributes that
    the faces of all have in one form, without materials. Of faces that lie back to back one is left. One mesh with
    nothing to remove and nothing to turn is returned as it is.

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
    from geokit.mesh.solids.operands import as_counted
    from geokit.mesh.surfaces.surface import Surface

    joined = _joined(*_read("union", mesh, others))
    if not joined.face_count:
        return joined
    surface = Surface(joined, device="cpu")
    boundary = boundary_of(surface)
    if boundary.kept:
        raise InputError(
            f"{joined.name or 'mesh'}: its union is not right: {boundary.kept}; repair the bodies one by one, such as "
            "with merge_vertices and orient"
        )
    return boundary.mesh if boundary.source is not None else as_counted(surface)[0]


@needs(_bytes, late=True)
def difference(mesh: MeshLike, *others: MeshLike) -> TriangleMesh:
    """The boundary of what a mesh encloses and none of others does.

    Each mesh is read as by :func:`union` first: bodies that overlap or touch count once, cavities are empty, sheets
    inside of bodies are removed. Faces of ``others`` are turned where they become walls.

    The difference is exact but for the rounding of new vertices (manifold3d). Of walls in one plane no skin and no slit
    is left: where planes are equal but for rounding, up to 1e-6 of the size of all meshes, ``others`` grow by as much
    as that takes, at most 1e-6 of the size. The result is compared with winding numbers of each mesh on both sides of
    its faces.

    Parts and attributes are those of :func:`union`: the part of a mesh are the faces that lie in its faces. Where no
    box of the others meets that of ``mesh``, the union of ``mesh`` alone is returned; where nothing is left, a mesh
    without faces.

    Args:
        mesh: Triangles; it may be empty.
        others: What is subtracted, in the same unit and with the same axis up, if they say any; they may be empty.
    Returns:
        TriangleMesh with the name of the first one.
    Raises:
        InputError: An argument is no mesh, units or axes differ, a mesh is open or more than 0.1% of the surface of
            its bodies lies inside of themselves, or the difference cannot be made; the message says which and why.
        MissingDependencyError: manifold3d is not installed.
        DeviceMemoryError: There is not enough memory.
    Source:
        Manifold, by Lalish et al.; winding numbers: Barill et al. (2018).
    Example:
        >>> hollow = gk.mesh.difference(gk.mesh.box((3, 3, 3)), gk.mesh.box())
        >>> hollow.area, hollow.volume
        (60.0, 26.0)
    """
    return _combined("Subtract", *_read("difference", mesh, others))


@needs(_bytes, late=True)
def intersection(mesh: MeshLike, *others: MeshLike) -> TriangleMesh:
    """The boundary of what all of several meshes enclose.

    Meshes are read, attributes kept and the result is compared as by :func:`difference`. Bodies that only touch have
    nothing in common, also but for rounding: where planes are equal up to 1e-6 of the size of all meshes, ``others``
    shrink by as much as that takes, at most 1e-6 of the size.

    Args:
        mesh: Triangles; it may be empty, and so is the result then.
        others: Further meshes, in the same unit and with the same axis up, if they say any; they may be empty.
    Returns:
        TriangleMesh with the name of the first one.
    Raises:
        InputError: An argument is no mesh, units or axes differ, a mesh is open or more than 0.1% of the surface of
            its bodies lies inside of themselves, or the intersection cannot be made; the message says which and why.
        MissingDependencyError: manifold3d is not installed.
        DeviceMemoryError: There is not enough memory.
    Source:
        Manifold, by Lalish et al.; winding numbers: Barill et al. (2018).
    Example:
        >>> gk.mesh.intersection(gk.mesh.box(), gk.mesh.box(center=(0.5, 0.5, 0.5))).volume
        0.125
    """
    return _combined("Intersect", *_read("intersection", mesh, others))


def _combined(verb: Verb, meshes: list[TriangleMesh], world: dict[str, Any]) -> TriangleMesh:
    from geokit.mesh.solids.operands import made_of, read_operand
    from geokit.mesh.surfaces.surface import Surface

    joined = _joined(meshes, world)
    begins = [0, *accumulate(mesh.face_count for mesh in meshes)]
    nothing = derived(with_data(joined, vertex_data={}), np.zeros((0, 3)), joined.faces[:0], face_source=np.arange(0))
    low, high = np.stack([mesh.bounds for mesh in meshes], axis=1)
    # Without faces these are NaN, which meets none.
    asked = np.flatnonzero(((low[0] <= high) & (low <= high[0])).all(axis=1))
    if 0 not in asked or (verb == "Intersect" and len(asked) < len(meshes)):
        return nothing
    names = ["mesh", *(f"others[{number}]" for number in range(len(meshes) - 1))]
    operands = [read_operand(Surface(meshes[at], device="cpu"), names[at], begins[at]) for at in asked]
    if len(operands) == 1:
        return operands[0].surface.mesh
    pieces = made_of(operands, verb)
    order = np.argsort(pieces.source, kind="stable")
    plain = with_data(joined, vertex_data={}, corner_data={})
    return derived(plain, pieces.vertices, pieces.faces[order], face_source=pieces.source[order])


def _read(verb: str, mesh: MeshLike, others: tuple[MeshLike, ...]) -> tuple[list[TriangleMesh], dict[str, Any]]:
    """The meshes, and the unit and the axis up that they say together."""
    if isinstance(mesh, (list, tuple)) and mesh and all(isinstance(one, TriangleMesh) for one in mesh):
        raise InputError(f"mesh: a {type(mesh).__name__} of meshes; give each of them: {verb}(*meshes)")
    named = {"mesh": mesh, **{f"others[{number}]": other for number, other in enumerate(others)}}
    meshes = {name: require_mesh(each, name) for name, each in named.items()}
    return [*meshes.values()], require_one_world(**meshes)


def _joined(meshes: list[TriangleMesh], world: dict[str, Any]) -> TriangleMesh:
    """One mesh of all of them, each with its vertices and as a part."""
    if len(meshes) == 1:
        return meshes[0]
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
        {**world, "face_data": _in_all(meshes)},
    )


def _in_all(meshes: list[TriangleMesh]) -> dict[str, Any]:
    """The attributes that the faces of all meshes have, in one form; rows of materials mean another one in each."""
    first, *others = [mesh for mesh in meshes if mesh.face_count] or meshes[:1]
    forms = [{name: (v.dtype, v.shape[1:]) for name, v in mesh.face_data.items()} for mesh in (first, *others)]
    names = [name for name in forms[0] if name != "material" and all(one.get(name) == forms[0][name] for one in forms)]
    return {name: np.concatenate([mesh.face_data[name] for mesh in (first, *others)]) for name in names}
