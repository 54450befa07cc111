"""Decides which faces are left out where signs are decided: second sides of faces, and sheets inside of closed bodies.

Some programs write each face twice, once for each side. The two cancel, so that nothing is inside. One of the two is
left out on each closed component, unless that component lies inside a solid: there the two are the contact of two
solids, or of a core and its shell.

Open sheets inside of bodies are decks, ribs, partitions. A single one has a winding number of up to 1/2 beside it, and
those of several add up: beside three decks of a closed hull it can be anything from -1/2 to 5/2. The hull alone says
what is inside.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.late_warp import wp
from geokit.core.memory.pinned import host_flags
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.topology.audit import face_parts
from geokit.mesh.topology.bodies import closed_bodies
from geokit.mesh.topology.connectivity import Topology, connected_components
from geokit.mesh.topology.measures import largest_of_each
from geokit.mesh.topology.normals import face_normals

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface

# Distance of a test point from its face, as a share of the square root of twice the face's area.
OFF_FACE = 1e-2

# Sides of a face are looked at this far from it, as a share of the mesh's size; nearer surfaces touch.
CONTACT = 1e-6
# Beyond, winding numbers are refused: products of lengths leave the range of float64.
EXTREME_SIZE = 1e70
# A point inside of a triangle that lies on no line of symmetry, as weights of its corners: bodies often have edges and
# planes through the middle of each other's faces.
INNER_POINT = np.array([0.2957, 0.3731, 0.3312])
# From a sheet's middle to its corners, where it is looked at whether it lies inside: a sheet may touch the walls.
TOWARD_CORNER = 0.999


def left_out_faces(surface: Surface) -> NDArray[np.int64]:
    """Rows of the faces that are left out, ascending."""
    copies, piece, whole = surface._orientation.doubled
    if not whole.any():
        return np.asarray(copies)
    frame = surface._frame
    corners = (surface.mesh.vertices - frame.origin)[surface.mesh.faces[copies[whole]]] / frame.scale
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(normals, axis=1)
    rows = largest_of_each(piece[whole], twice)
    size = np.sqrt(twice[rows])[:, None]
    normals = normals[rows] / np.maximum(twice[rows], np.finfo(float).tiny)[:, None]
    starts = (corners[rows].mean(axis=1) + OFF_FACE * size * normals) * frame.scale + frame.origin
    points: Any = wp.array(starts, dtype=wp.vec3d, device=surface._device)
    # Doubled faces cancel here, so that this is the winding number of all others.
    winding = surface._winding(points, host_flags(1, surface._device), surface._winding_arguments_of_all()).numpy()
    within = piece[whole][rows][winding > 0.5]
    return np.asarray(copies[~(whole & np.isin(piece, within))])


def inner_sheets(surface: Surface) -> NDArray[np.int64]:
    """Rows of the faces of sheets that lie inside of the closed bodies of a surface's mesh, ascending."""
    mesh, none = surface.mesh, np.empty(0, np.int64)
    size = float((mesh.bounds[1] - mesh.bounds[0]).max())
    if not 1.0 / EXTREME_SIZE < size < EXTREME_SIZE or not _may_have_sheets(surface._topology.edges):
        return none
    flipped = surface._orientation.flipped[:, None]
    oriented = TriangleMesh(mesh.vertices, np.where(flipped, mesh.faces[:, ::-1], mesh.faces))
    flat = collapsed(oriented.vertices[oriented.faces])
    found = none
    # Where one wall stands between two solids there are two readings: the one that leaves no sheet outside, else the
    # first.
    for bodies in closed_bodies(oriented)[::-1]:
        solid, sheets = np.flatnonzero(bodies.label >= 0), np.flatnonzero((bodies.label < 0) & ~flat)
        if len(solid) and len(sheets):
            judge = surface._of(TriangleMesh(oriented.vertices, oriented.faces[solid]), device=surface._device)
            found, outer = sheets_inside(oriented, sheets, judge, CONTACT * size)
            found = np.sort(found[_leave_boundary(oriented, found, judge, CONTACT * size)])
            if not len(outer):
                break
    return found


def _leave_boundary(mesh: TriangleMesh, sheets: NDArray[np.int64], judge: Any, off: float) -> NDArray[np.bool_]:
    """Whether the sheet of each face has faces that do not lie on the bodies: others are copies of their faces."""
    if not len(sheets):
        return np.zeros(0, bool)
    _, sheet = np.unique(face_parts(TriangleMesh(mesh.vertices, mesh.faces[sheets])), return_inverse=True)
    apart = judge.closest_point(INNER_POINT @ mesh.vertices[mesh.faces[sheets]]).distance > off
    return np.asarray(np.bincount(sheet, apart)[sheet] > 0)


def _may_have_sheets(edges: Topology) -> bool:
    """Whether some faces may bound a body and others may not: quick to see where no edge has more than two faces."""
    if edges.only_pairs:
        return False
    if edges.non_manifold_count:
        return True
    one, other = edges.pairs
    component = connected_components(len(edges.faces), one // 3, other // 3)
    is_open = np.zeros(len(component), bool)
    is_open[component[edges.order[edges.starts[edges.uses == 1]] // 3]] = True
    return not bool(is_open[component].all())


def collapsed(corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether two corners of a triangle, (F, 3, 3), are in one place."""
    found: NDArray[np.bool_] = (corners == np.roll(corners, 1, axis=1)).all(axis=2).any(axis=1)
    return found


def sheets_inside(
    mesh: TriangleMesh, sheets: NDArray[np.int64], judge: Any, off: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of those sheets all of whose faces have the solid on both sides, and of all others.

    Args:
        mesh: The mesh.
        sheets: Rows of the faces of sheets.
        judge: A surface that has the winding numbers of the solids.
        off: How far from a face its sides are looked at [world].
    """
    _, sheet = np.unique(face_parts(TriangleMesh(mesh.vertices, mesh.faces[sheets])), return_inverse=True)
    # The first face of each rules most of them out.
    _, first = np.unique(sheet, return_index=True)
    begins = is_inside(mesh.vertices[mesh.faces[sheets[first]]], judge, off)
    hidden = begins[sheet]
    hidden[hidden] = is_inside(mesh.vertices[mesh.faces[sheets[hidden]]], judge, off)
    whole = np.bincount(sheet, ~hidden) == 0
    return sheets[whole[sheet]], sheets[~whole[sheet]]


def is_inside(corners: NDArray[np.float64], judge: Any, off: float) -> NDArray[np.bool_]:
    """Whether triangles (F, 3, 3) have the solid on both sides, or lie on its boundary."""
    middle = (INNER_POINT @ corners)[:, None]
    places = np.concatenate([middle, middle + TOWARD_CORNER * (corners - middle)], axis=1)
    triangles = TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    step = off * face_normals(triangles)[:, None]
    inside = np.ones(places.shape[:2], bool)
    for side in (step, -step):
        inside &= judge.winding_number((places + side).reshape(-1, 3)).reshape(inside.shape) > 0.5
    inside[~inside] = judge.closest_point(places[~inside]).distance <= off
    return np.asarray(inside.all(axis=1))
