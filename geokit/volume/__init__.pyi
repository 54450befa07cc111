# The volume itself, and files.
from .model.sparse_volume import SparseVolume as SparseVolume
from .nanovdb.grid_info import GridInfo as GridInfo
from ._io import load as load, load_all as load_all, save as save, inspect as inspect

# Volumes from meshes, points, functions and arrays.
from .distance_fields.from_mesh import (
    from_mesh as from_mesh,
    from_mesh_with_triangles as from_mesh_with_triangles,
    MeshBand as MeshBand,
)
from .streamed.from_mesh_file import from_mesh_file as from_mesh_file
from .distance_fields.plan import plan as plan, PlannedField as PlannedField
from ._from_points import from_points as from_points
from ._from_function import from_function as from_function
from ._dense import from_dense as from_dense, to_dense as to_dense, DenseGrid as DenseGrid
from ._convert import to_pyvista as to_pyvista, to_xarray as to_xarray
from .retyped.from_channel import from_channel as from_channel, channel_names as channel_names

# The active voxels and their values as flat arrays.
from ._values import active_voxels as active_voxels, with_values as with_values, ActiveVoxels as ActiveVoxels

# Queries at points and along rays.
from .at_points.sample import sample as sample, gradient as gradient
from ._curvature import hessian as hessian, curvature as curvature, Curvatures as Curvatures
from .at_points.active import active_at as active_at
from ._raycast import raycast as raycast, VolumeHits as VolumeHits
from ._integrate import integrate as integrate, Transmittance as Transmittance
from ._statistics import statistics as statistics, Statistics as Statistics

# Operations on level sets.
from ._csg import union as union, intersection as intersection, difference as difference
from ._morphology import (
    offset as offset,
    dilate as dilate,
    erode as erode,
    opening as opening,
    closing as closing,
    renormalize as renormalize,
)

# Operations that make other volumes.
from ._filters import smooth as smooth
from ._differential import (
    gradient_field as gradient_field,
    divergence as divergence,
    curl as curl,
    laplacian as laplacian,
)
from ._resample import resample as resample
from .retyped.quantize import quantize as quantize
from ._topology import clip as clip, prune as prune
from ._components import (
    connected_components as connected_components,
    segment as segment,
    ConnectedComponents as ConnectedComponents,
)

# Distance fields of several voxel sizes: small voxels only where edges need them.
from .distance_fields.adaptive import (
    adaptive_from_mesh as adaptive_from_mesh,
    load_adaptive as load_adaptive,
    AdaptiveSDF as AdaptiveSDF,
)
