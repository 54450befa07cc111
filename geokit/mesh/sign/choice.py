"""How the solid that a mesh bounds is told: by pseudonormals if the mesh is proven clean, else by winding numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from geokit.mesh.topology.audit import face_parts
from geokit.mesh.topology.measures import largest_of_each

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface
    from geokit.mesh.topology.orientation import FaceOrientation

__all__ = ["SignChoice", "choose_sign"]

# Winding numbers below this count as 0: twenty times their error.
WHOLE = 0.1


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
