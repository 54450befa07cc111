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
from geokit.mesh.sign.left_out import collapsed, left_out_faces
from geokit.mesh.solids.boundary import boundary_of
from geokit.mesh.solids.contact import within_contact
from geokit.mesh.solids.judging import verdict_of
from geokit.mesh.solids.pieces import Pieces, Verb, boxes_that_meet, combined, pieces_of, together
from geokit.mesh.topology.bodies import closed_bodies

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface

NAMES = {"Subtract": "difference", "Intersect": "intersection"}


class Operand(NamedTuple):
    """What a mesh encloses.

    Attributes:
        surface: A surface of the boundary of that, solids outward.
        solid: The boundary, in which no two bodies share a vertex; its source are faces of the mesh that was given.
    """

    surface: Surface
    solid: Pieces


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
    sources: Any = {"vertex_source": used, "face_source": source, "reversed_faces": flipped}
    return derived(mesh, mesh.vertices[used], faces, **sources), source


def read_operand(surface: Surface, name: str, begin: int) -> Operand:
    """What a surface's mesh encloses; its faces are numbered from ``begin`` on, errors begin with ``name``."""
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
    solid = pieces_of(bodies.positions, bodies.corners, rows)._replace(source=source[rows] + begin)
    return Operand(surface if mesh is surface.mesh else surface._of(mesh, device=surface._device), solid)


def made_of(operands: Sequence[Operand], verb: Verb) -> Pieces:
    """The boundary of what operands are together; an InputError if that cannot be made."""
    surfaces, solids = zip(*operands, strict=True)
    given = together(solids)
    size = float(np.ptp(given.vertices, axis=0).max())
    ends = np.cumsum([len(solid.vertices) for solid in solids[:-1]])
    lower, upper = np.stack([surface.bounds for surface in surfaces], axis=1)

    def make(places: NDArray[np.float64]) -> Pieces | None:
        each = zip(np.split(places, ends), solids, strict=True)
        return combined([solid._replace(vertices=place) for place, solid in each], verb)

    def inside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        found = np.ones(len(points), bool)
        for number, surface in enumerate(surfaces):
            is_within = surface.winding_number(points[found]) > 0.5
            found[found] = ~is_within if number and verb == "Subtract" else is_within
        return found

    def near(within: float) -> bool:
        for one, other in zip(*boxes_that_meet(lower, upper, within), strict=True):
            # What is subtracted from the first one lies beside what it leaves of it as if that were inside out.
            sense = -1.0 if verb == "Subtract" and 0 in (one, other) else 1.0
            if surfaces[one]._has_facing(surfaces[other], within, sense):
                return True
        return False

    # Walls in one plane but for rounding: what is subtracted grows, so that no skin is left of the first one; for an
    # intersection all but the first one shrink, so that bodies that touch have nothing in common.
    sign = 1.0 if verb == "Subtract" else -1.0
    verdict = partial(verdict_of, given, inside, partial(surfaces[0]._of, device=surfaces[0]._device), size)
    moving = given.faces[len(solids[0].faces) :]
    pieces, kept = within_contact(make, verdict, given.vertices, moving, size, near, sign)
    if pieces is None or kept:
        raise InputError(
            f"others: their {NAMES[verb]} with mesh is not right: winding numbers contradict it; repair the meshes one "
            "by one, such as with merge_vertices and orient"
        )
    return pieces
