"""Differences and intersections of meshes: each is read as for a union first, and what is made is held against the
winding numbers of each.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError
from geokit.mesh.attributes.derived import derived, used_vertices
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.sign.inner_sheets import collapsed
from geokit.mesh.sign.left_out import left_out_faces
from geokit.mesh.solids.boundary import boundary_of
from geokit.mesh.solids.contact import within_contact
from geokit.mesh.solids.judging import verdict_of
from geokit.mesh.solids.pieces import Pieces, Solid, Verb, combined, solid_of
from geokit.mesh.topology.bodies import closed_bodies

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface

__all__ = ["Operand", "as_counted", "made_of", "read_operand"]

NAMES = {"Subtract": "difference", "Intersect": "intersection"}


class Operand(NamedTuple):
    """What a mesh encloses.

    Attributes:
        mesh: The boundary of that, solids outward.
        solid: The same, in which no two bodies share a vertex; rows are those of the mesh that was given.
        surface: A surface of the boundary.
    """

    mesh: TriangleMesh
    solid: Solid
    surface: Surface


def as_counted(surface: Any) -> tuple[TriangleMesh, NDArray[np.int64]]:
    """The mesh without the second of faces back to back, and with solids outward; rows of the faces that are left."""
    mesh: TriangleMesh = surface.mesh
    source = np.arange(mesh.face_count)
    if surface._counted is not surface:
        source = np.delete(source, left_out_faces(surface))
    flipped = surface._counted._orientation.flipped
    if len(source) == mesh.face_count and not flipped.any():
        return mesh, source
    faces = np.where(flipped[:, None], mesh.faces[source, ::-1], mesh.faces[source])
    used, faces = used_vertices(faces, mesh.vertex_count)
    turned = derived(
        mesh, mesh.vertices[used], faces, vertex_source=used, face_source=source, reversed_faces=flipped
    )  # fmt: skip
    return turned, source


def read_operand(surface: Surface, name: str) -> Operand:
    """What a surface's mesh encloses.

    Raises:
        InputError: The mesh is open, or crosses itself; the message begins with ``name``.
    """
    boundary = boundary_of(surface)
    if boundary.kept:
        raise InputError(
            f"{name}: {boundary.kept}; repair it, such as with merge_vertices and orient, or take what a "
            "level set of it bounds: mesh.from_volume(volume.from_mesh(mesh, voxel_size))"
        )
    mesh, source = (boundary.mesh, boundary.source) if boundary.source is not None else as_counted(surface)
    bodies = closed_bodies(mesh, surface._topology if mesh is surface.mesh else None)[0]
    loose = np.flatnonzero(bodies.label < 0)
    loose = loose[~collapsed(mesh.vertices[mesh.faces[loose]])]
    if len(loose):
        raise InputError(
            f"{name}: is open: {len(loose)} faces are of no closed body, such as face {source[loose[0]]}; close it, or "
            "make a solid shell of it: mesh.from_volume(volume.from_mesh(mesh, voxel_size, thickness=...))"
        )
    rows = np.flatnonzero(bodies.label >= 0)
    solid = solid_of(bodies, rows, bodies.positions)._replace(rows=source[rows])
    return Operand(mesh, solid, surface if mesh is surface.mesh else surface._of(mesh, device=surface._device))


def made_of(operands: Sequence[Operand], begins: Sequence[int], verb: Verb) -> Pieces:
    """The boundary of what operands are together; the faces of each are numbered from its entry of ``begins`` on.

    Raises:
        InputError: It cannot be made.
        MissingDependencyError: manifold3d is not installed.
        DeviceMemoryError: There is not enough memory for it.
    """
    solids = [each.solid for each in operands]
    ends = np.cumsum([len(solid.positions) for solid in solids])
    positions = np.concatenate([solid.positions for solid in solids])
    corners = [solid.corners + (end - len(solid.positions)) for solid, end in zip(solids, ends, strict=True)]
    size = float(np.ptp(positions, axis=0).max())

    def make(places: NDArray[np.float64]) -> Pieces | None:
        each = zip(np.split(places, ends[:-1]), solids, begins, strict=True)
        return combined([Solid(place, solid.corners, solid.rows + begin) for place, solid, begin in each], verb)

    def inside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        found = np.ones(len(points), bool)
        for number, operand in enumerate(operands):
            is_within = operand.surface.winding_number(points[found]) > 0.5
            found[found] = ~is_within if number and verb == "Subtract" else is_within
        return found

    def verdict(pieces: Pieces, moved: float) -> str:
        make_surface = partial(operands[0].surface._of, device=operands[0].surface._device)
        rows = np.concatenate([solid.rows + begin for solid, begin in zip(solids, begins, strict=True)])
        return verdict_of(positions, np.concatenate(corners), rows, pieces, inside, make_surface, size, moved)

    surfaces = [operand.surface for operand in operands]
    lower, upper = np.stack([surface.bounds for surface in surfaces], axis=1)

    def near(within: float) -> bool:
        meet = np.triu((lower[:, None] <= upper[None] + within).all(axis=2), 1)
        meet &= (lower[None] <= upper[:, None] + within).all(axis=2)
        # What is subtracted from the first one lies beside what it leaves of it as if that were inside out.
        return any(
            surfaces[one]._faces_up_to(surfaces[other], within, -1.0 if verb == "Subtract" and not one else 1.0)
            for one, other in np.argwhere(meet)
        )

    # Walls in one plane but for rounding: what is subtracted grows, so that no skin is left of the first one; for an
    # intersection all but the first one shrink, so that bodies that touch have nothing in common.
    sign = 1.0 if verb == "Subtract" else -1.0
    pieces, kept = within_contact(make, verdict, positions, np.concatenate(corners[1:]), size, near, sign)
    if pieces is None or kept:
        raise InputError(
            f"others: their {NAMES[verb]} with mesh is not right: winding numbers contradict it; repair the meshes one "
            "by one, such as with merge_vertices and orient"
        )
    return pieces
