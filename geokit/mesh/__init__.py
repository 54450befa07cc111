"""Triangle meshes: files, audit, queries."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geokit._lazy import make_lazy

if TYPE_CHECKING:
    from geokit.mesh.audit import MeshAudit, audit
    from geokit.mesh.from_volume import from_volume
    from geokit.mesh.io import load, save
    from geokit.mesh.model import MeshPart, TriangleMesh
    from geokit.mesh.surface import ClosestPoints, RayHits, SignedDistances, Surface

__all__ = [
    "ClosestPoints",
    "MeshAudit",
    "MeshPart",
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
        "ClosestPoints": "geokit.mesh.surface",
        "MeshAudit": "geokit.mesh.audit",
        "MeshPart": "geokit.mesh.model",
        "RayHits": "geokit.mesh.surface",
        "SignedDistances": "geokit.mesh.surface",
        "Surface": "geokit.mesh.surface",
        "TriangleMesh": "geokit.mesh.model",
        "audit": "geokit.mesh.audit",
        "from_volume": "geokit.mesh.from_volume",
        "load": "geokit.mesh.io",
        "save": "geokit.mesh.io",
    },
)
