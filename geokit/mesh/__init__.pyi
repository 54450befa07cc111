# The mesh itself, and files.
from ._model import TriangleMesh as TriangleMesh, MeshPart as MeshPart
from ._io import load as load, save as save

# Queries: a surface is prepared once and queried often.
from ._surface import Surface as Surface
from .queries.points import ClosestPoints as ClosestPoints, FurthestPoints as FurthestPoints
from .sign.queries import SignedDistances as SignedDistances
from .queries.rays import RayHits as RayHits, RayHitLists as RayHitLists
from .queries.overlaps import BoxOverlaps as BoxOverlaps

# What a mesh is fit for, and repairs.
from ._audit import audit as audit
from .topology.audit import MeshAudit as MeshAudit
from ._repair import (
    orient as orient,
    merge_vertices as merge_vertices,
    drop_degenerate as drop_degenerate,
    OrientedMesh as OrientedMesh,
)

# Distances between surfaces, fewer faces, points on a surface.
from ._hausdorff import (
    hausdorff as hausdorff,
    HausdorffDistance as HausdorffDistance,
    DirectedDistance as DirectedDistance,
)
from ._simplify import simplify as simplify, Simplified as Simplified
from ._sample_surface import sample_surface as sample_surface, SurfaceSamples as SurfaceSamples

# From volumes, and their values at vertices.
from ._from_volume import from_volume as from_volume, from_volume_with_deviation as from_volume_with_deviation
from ._attributes import sample_attributes as sample_attributes
