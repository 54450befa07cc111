"""Triangle meshes: files, audit, queries."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geokit._lazy import make_lazy

if TYPE_CHECKING:
    from geokit.mesh._point_queries import ClosestPoints, FurthestPoints, SignedDistances
    from geokit.mesh._ray_queries import RayHitLists, RayHits
    from geokit.mesh.audit import MeshAudit, audit
    from geokit.mesh.from_volume import from_volume
    from geokit.mesh.io import load, save
    from geokit.mesh.model import MeshPart, TriangleMesh
    from geokit.mesh.surface import Surface

__all__ = [
    "ClosestPoints",
    "FurthestPoints",
    "MeshAudit",
    "MeshPart",
    "RayHitLists",
    "RayHits",
    "SignedDistances",
    "Surface",
    "TriangleMesh",
    "audit",
    "from_volume",
    "load",
    "save",
]

make_lazy(
    __name__,
    {
        "ClosestPoints": "geokit.mesh._point_queries",
        "FurthestPoints": "geokit.mesh._point_queries",
        "MeshAudit": "geokit.mesh.audit",
        "MeshPart": "geokit.mesh.model",
        "RayHitLists": "geokit.mesh._ray_queries",
        "RayHits": "geokit.mesh._ray_queries",
        "SignedDistances": "geokit.mesh._point_queries",
        "Surface": "geokit.mesh.surface",
        "TriangleMesh": "geokit.mesh.model",
        "audit": "geokit.mesh.audit",
        "from_volume": "geokit.mesh.from_volume",
        "load": "geokit.mesh.io",
        "save": "geokit.mesh.io",
    },
)
