"""Defects, topology and measures of a mesh."""

from __future__ import annotations

from dataclasses import replace

from geokit.core.interop.types import MeshLike
from geokit.core.memory.needs import needs
from geokit.core.require import require_flag
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.topology.audit import MeshAudit, audit_topology
from geokit.mesh.topology.connectivity import mesh_topology


@needs(lambda mesh, **_: 118 * mesh.face_count)
def audit(mesh: MeshLike, *, self_intersections: bool = False) -> MeshAudit:
    """Defects, topology and measures of a mesh; :class:`MeshAudit` describes each of them.

    Counts are exact. Area and volume are summed in float64 relative to the center of the bounding box: the relative
    error is under 1e-12 for up to a million faces, also far from the origin, as far as the coordinates' own digits
    allow. Aspect ratios have a relative error of 1e-12 for triangles that are not slivers.

    Aspect ratios and areas of slivers have a relative error of 1e-15 times the aspect ratio. Triangles with an aspect
    ratio of 1e12 or more count as degenerate.

    Args:
        mesh: The mesh; it may be empty.
        self_intersections: Also count self-intersections. This takes longer than all the rest, because a
            :class:`geokit.mesh.Surface` is built for it.
    Returns:
        MeshAudit.
    Raises:
        InputError: mesh is not a TriangleMesh, or self_intersections is neither True nor False.
    Example:
        >>> audit(geokit.mesh.load("data/samples/bracket.obj")).watertight
        True
    """
    mesh = require_mesh(mesh, "mesh", images=False)
    require_flag(self_intersections, "self_intersections")
    report = audit_topology(mesh, mesh_topology(mesh))
    if not self_intersections:
        return report
    from geokit.mesh.surfaces.surface import Surface

    pairs = Surface(mesh, device="cpu").self_intersections() if mesh.face_count else ()
    return replace(report, self_intersection_count=len(pairs))
