# The mesh itself, and files.
from .model.triangle_mesh import TriangleMesh as TriangleMesh, MeshPart as MeshPart
from .model.data import Material as Material, Texture as Texture
from ._io import load as load, save as save

# Meshes of other libraries, in and out.
from .surfaces.objects import as_mesh as as_mesh
from ._convert import to_meshio as to_meshio, to_open3d as to_open3d, to_pyvista as to_pyvista, to_trimesh as to_trimesh

# Queries: a surface is prepared once and queried often.
from .surfaces.surface import Surface as Surface
from .surfaces.surfaces import Surfaces as Surfaces
from .queries.points import ClosestPoints as ClosestPoints, FurthestPoints as FurthestPoints
from .sign.queries import SignedDistances as SignedDistances
from .queries.rays import RayHits as RayHits, RayHitLists as RayHitLists
from .queries.overlaps import BoxOverlaps as BoxOverlaps
from .queries.distance import SurfaceDistance as SurfaceDistance
from .contacts.contacts import Contacts as Contacts
from .contacts.motion import TimeOfContact as TimeOfContact

# What a mesh is fit for, and repairs.
from ._audit import audit as audit
from .streamed.audit_file import audit_file as audit_file
from .topology.audit import MeshAudit as MeshAudit
from ._repair import (
    orient as orient,
    merge_vertices as merge_vertices,
    drop_degenerate as drop_degenerate,
    OrientedMesh as OrientedMesh,
)
from ._fill_holes import fill_holes as fill_holes, FilledHoles as FilledHoles
from ._repair_mesh import repair as repair, Repaired as Repaired
from ._untangle import remove_self_intersections as remove_self_intersections, Untangled as Untangled

# Pieces, affine maps, and simple bodies.
from ._split import split as split, keep_largest as keep_largest
from ._transform import transform as transform
from ._csg import union as union, difference as difference, intersection as intersection
from ._transform import convert_unit as convert_unit
from ._primitives import box as box, sphere as sphere, cylinder as cylinder
from ._primitives import cone as cone, torus as torus, plane as plane

# Distances between surfaces, fewer faces, points on a surface.
from ._hausdorff import (
    hausdorff as hausdorff,
    HausdorffDistance as HausdorffDistance,
    DirectedDistance as DirectedDistance,
)
from ._simplify import simplify as simplify, Simplified as Simplified
from ._sample_surface import sample_surface as sample_surface, SurfaceSamples as SurfaceSamples

# Attributes of another mesh.
from ._transfer import transfer_attributes as transfer_attributes

# From volumes, and their values at vertices.
from .volumes.from_volume import from_volume as from_volume, from_volume_with_deviation as from_volume_with_deviation
from .volumes.attributes import sample_attributes as sample_attributes
from .volumes.wrap import wrap as wrap, Wrapped as Wrapped
