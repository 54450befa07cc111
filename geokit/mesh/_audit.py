"""What a mesh is fit for: closedness, manifoldness, orientation, defects, volume."""

from __future__ import annotations

from dataclasses import replace

from geokit.mesh._model import TriangleMesh
from geokit.mesh.topology.audit import MeshAudit, audit_topology
from geokit.mesh.topology.connectivity import mesh_topology

__all__ = ["audit"]


def audit(mesh: TriangleMesh, *, self_intersections: bool = False) -> MeshAudit:
    """Defects, topology and measures of a mesh; see :class:`MeshAudit` for each.

    Counts are exact. Area and volume are summed in float64 relative to the middle of the bounds: relative error under
    1e-12 for up to a million faces, also far away from the origin as far as the coordinates' own digits go. Aspect
    ratios are good to 1e-12 of themselves for triangles that are not slivers (tests/mesh/topology/test_audit.py).

    Aspect ratios and areas of slivers are good to 1e-15 times the aspect ratio; from 1e12 on they count as degenerate.
    Held by tests/accuracy/stability/test_envelopes.py.

    Args:
        mesh: The mesh; it may be empty.
        self_intersections: Count them as well, which takes longer than all the rest: a :class:`geokit.mesh.Surface` is
            made for it.
    Returns:
        MeshAudit.
    Example:
        >>> audit(geokit.mesh.load("data/samples/bracket.obj")).watertight
        True
    """
    report = audit_topology(mesh, mesh_topology(mesh))
    return replace(report, self_intersection_count=_self_intersection_count(mesh)) if self_intersections else report


def _self_intersection_count(mesh: TriangleMesh) -> int:
    if len(mesh.faces) == 0:
        return 0
    from geokit.mesh._surface import Surface

    return len(Surface(mesh, device="cpu").self_intersections())
