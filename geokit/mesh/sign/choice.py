"""How the solid that a mesh bounds is told: by pseudonormals if the mesh is proven clean, else by winding numbers.

An open sheet, as a terrain, a design surface or one side of a scanned wall, encloses nothing. Beside it the winding
number is about 1/2 on one side and -1/2 on the other, so whether it exceeds 1/2 is left to rounding and to the sheet's
rim. The normals of its faces say which side is which, where it is wound alike.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from geokit.core.base.late_warp import wp
from geokit.core.memory.pinned import host_flags
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.sign.left_out import EXTREME_SIZE, INNER_POINT
from geokit.mesh.topology.audit import face_parts
from geokit.mesh.topology.bodies import closed_bodies
from geokit.mesh.topology.measures import largest_of_each

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface
    from geokit.mesh.topology.orientation import FaceOrientation

# Winding numbers below this count as 0: twenty times their error.
WHOLE = 0.1
# Points on the surface, spread by area, at which it is asked how much the mesh encloses.
SAMPLES = 512
# Distance of the two sides of a sample from it, in roots of its face's area: the winding number is 1 apart there.
OFF = 0.05
# The sum of the winding numbers on the two sides is 1 all over a closed body, and 0 in the middle of a plane; a sphere
# without a tenth of its area has 0.9, a hemisphere 0.6, half a tube 1/2. A mesh whose mean is below encloses nothing.
ENCLOSES = 0.5
# Sheets of fewer faces on the mean are loose ones, of a soup or of leaves, if there are more than a few: each has its
# own sides, and together they have none.
LOOSE_FACES, FEW_SHEETS = 8, 16


class SignChoice(NamedTuple):
    """The sign method, the reason for it, and whether its signs mean nothing all the same."""

    method: str
    reason: str
    means_nothing: bool = False


def choose_sign(surface: Surface) -> SignChoice:
    """Cheap proofs first: the audit's counts, then self-intersections, then the nesting of the components."""
    defect = _defect(surface.audit, surface._orientation)
    if not defect and surface._has_self_intersections():
        defect = "faces that intersect"
    if not defect and surface.audit.component_count > 1 and not _parts_bound_one_solid(surface):
        defect = "parts within each other that are not cavities"
    if defect:
        return SignChoice("winding", defect)
    return SignChoice("pseudonormal", "closed, manifold, wound alike, no intersections")


def _defect(report: Any, orientation: FaceOrientation) -> str:
    """The mesh's first defect for which pseudonormals fail, or an empty string."""
    counts = (
        (report.back_to_back_count, "pairs of faces back to back, which cancel"),
        (report.boundary_edge_count, "boundary edges"),
        (report.non_manifold_edge_count, "edges of three faces or more"),
        (report.degenerate_count, "faces without area"),
        (report.duplicate_count, "duplicate faces"),
    )
    for count, what in counts:
        if count:
            return f"{what}: {count}"
    if not report.manifold:
        return "vertices that separate fans share"
    return "" if orientation.closed else "faces that cannot be wound alike"


def _parts_bound_one_solid(surface: Surface) -> bool:
    """Whether the winding number is 0 in front of each component and so 1 behind it, as pseudonormals assume.

    It is constant along a component, because no two intersect. It is evaluated in front of the component's largest
    face, halfway to the next obstacle.
    """
    frame = surface._frame
    # At unit size, so that the squares of lengths neither overflow nor underflow.
    corners = ((surface.mesh.vertices - frame.origin) / frame.scale)[surface.mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals[surface._orientation.flipped] *= -1.0
    twice = np.linalg.norm(normals, axis=1)
    face = largest_of_each(face_parts(surface.mesh), twice)
    starts = corners[face].mean(axis=1) * frame.scale + frame.origin
    headings = normals[face] / twice[face, None]
    hits = surface.raycast_all(starts, headings)
    ray = np.repeat(np.arange(len(face)), np.diff(hits.offsets))
    others = hits.triangle_id != face[ray]
    room = np.sqrt(twice[face]) * frame.scale
    np.minimum.at(room, ray[others], hits.t[others])
    winding = surface.winding_number(starts + 0.5 * room[:, None] * headings)
    return bool((np.abs(winding) < WHOLE).all())


def choose_side(surface: Surface) -> SignChoice:
    """How ``sign="auto"`` tells the sides of a surface: as its solid does, and by normals if it encloses nothing."""
    solid, audit = surface._solid_choice, surface.audit
    is_closed = not audit.boundary_edge_count and not audit.back_to_back_count
    if solid.method == "pseudonormal" or is_closed or _encloses(surface):
        return solid
    nothing = f"encloses nothing ({audit.boundary_edge_count} boundary edges)"
    defects = (
        (audit.back_to_back_count, f"has pairs of faces back to back, which cancel: {audit.back_to_back_count}"),
        (audit.non_manifold_edge_count, "has edges of three faces or more"),
        (not surface._orientation.consistent, "cannot be wound alike"),
        (
            audit.component_count > FEW_SHEETS and audit.face_count < LOOSE_FACES * audit.component_count,
            "consists of loose faces",
        ),
    )
    for count, what in defects:
        if count:
            return SignChoice("winding", f"{nothing} and {what}", means_nothing=True)
    return SignChoice("pseudonormal", f"{nothing}: the normals of its faces tell the sides")


def _encloses(surface: Surface) -> bool:
    """Whether there is a closed body, or an open one, as a scan with holes."""
    mesh, frame = surface.mesh, surface._frame
    if not 1.0 / EXTREME_SIZE < frame.scale < EXTREME_SIZE:
        return True
    flipped = surface._orientation.flipped[:, None]
    faces = np.where(flipped, mesh.faces[:, ::-1], mesh.faces)
    # At unit size, so that areas neither overflow nor underflow.
    corners = ((mesh.vertices - frame.origin) / frame.scale)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(normals, axis=1)
    ends = np.cumsum(twice)
    if not ends[-1] > 0.0:
        return True
    chosen = np.searchsorted(ends, (np.arange(SAMPLES) + 0.5) / SAMPLES * ends[-1])
    middle, side = INNER_POINT @ corners[chosen], OFF * normals[chosen] / np.sqrt(twice[chosen])[:, None]
    points = np.concatenate([middle + side, middle - side]) * frame.scale + frame.origin
    rows: Any = wp.array(points, dtype=wp.vec3d, device=surface._device)
    winding = surface._winding(rows, host_flags(1, surface._device)).numpy()
    if abs(float(winding.mean())) >= 0.5 * ENCLOSES:
        return True
    return any((body.label >= 0).any() for body in closed_bodies(TriangleMesh(mesh.vertices, faces)))
