"""Triangle meshes: files, audit and repair, simplification, queries, sampling, distances between them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geokit._lazy import make_lazy

if TYPE_CHECKING:
    from geokit.mesh._overlap_queries import BoxOverlaps
    from geokit.mesh._point_queries import ClosestPoints, FurthestPoints
    from geokit.mesh._ray_queries import RayHitLists, RayHits
    from geokit.mesh._sign_queries import SignedDistances
    from geokit.mesh.attributes import sample_attributes
    from geokit.mesh.audit import MeshAudit, audit
    from geokit.mesh.from_volume import from_volume, from_volume_with_deviation
    from geokit.mesh.hausdorff import DirectedDistance, HausdorffDistance, hausdorff
    from geokit.mesh.io import load, save
    from geokit.mesh.model import MeshPart, TriangleMesh
    from geokit.mesh.repair import OrientedMesh, drop_degenerate, merge_vertices, orient
    from geokit.mesh.sample_surface import SurfaceSamples, sample_surface
    from geokit.mesh.simplify import Simplified, simplify
    from geokit.mesh.surface import Surface

__all__ = [
    "BoxOverlaps",
    "ClosestPoints",
    "DirectedDistance",
    "FurthestPoints",
    "HausdorffDistance",
    "MeshAudit",
    "MeshPart",
    "OrientedMesh",
    "RayHitLists",
    "RayHits",
    "SignedDistances",
    "Simplified",
    "Surface",
    "SurfaceSamples",
    "TriangleMesh",
    "audit",
    "drop_degenerate",
    "from_volume",
    "from_volume_with_deviation",
    "hausdorff",
    "load",
    "merge_vertices",
    "orient",
    "sample_attributes",
    "sample_surface",
    "save",
    "simplify",
]

make_lazy(
    __name__,
    {
        "BoxOverlaps": "geokit.mesh._overlap_queries",
        "ClosestPoints": "geokit.mesh._point_queries",
        "DirectedDistance": "geokit.mesh.hausdorff",
        "FurthestPoints": "geokit.mesh._point_queries",
        "HausdorffDistance": "geokit.mesh.hausdorff",
        "MeshAudit": "geokit.mesh.audit",
        "MeshPart": "geokit.mesh.model",
        "OrientedMesh": "geokit.mesh.repair",
        "RayHitLists": "geokit.mesh._ray_queries",
        "RayHits": "geokit.mesh._ray_queries",
        "SignedDistances": "geokit.mesh._sign_queries",
        "Simplified": "geokit.mesh.simplify",
        "Surface": "geokit.mesh.surface",
        "SurfaceSamples": "geokit.mesh.sample_surface",
        "TriangleMesh": "geokit.mesh.model",
        "audit": "geokit.mesh.audit",
        "drop_degenerate": "geokit.mesh.repair",
        "from_volume": "geokit.mesh.from_volume",
        "from_volume_with_deviation": "geokit.mesh.from_volume",
        "sample_attributes": "geokit.mesh.attributes",
        "hausdorff": "geokit.mesh.hausdorff",
        "load": "geokit.mesh.io",
        "merge_vertices": "geokit.mesh.repair",
        "orient": "geokit.mesh.repair",
        "sample_surface": "geokit.mesh.sample_surface",
        "save": "geokit.mesh.io",
        "simplify": "geokit.mesh.simplify",
    },
)
