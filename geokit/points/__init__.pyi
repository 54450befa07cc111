# The cloud itself, and files.
from ._io import PointCloud as PointCloud, load as load, save as save, load_rays as load_rays

# Clouds for other libraries; those of other libraries are taken everywhere.
from ._convert import to_open3d as to_open3d, to_pyvista as to_pyvista, to_trimesh as to_trimesh

# Points on a mesh, with its attributes.
from ._sample import sample as sample

# Neighbors: a grid is prepared once and queried often.
from .neighbors.neighbor_grid import (
    NeighborGrid as NeighborGrid,
    Neighbors as Neighbors,
    Candidates as Candidates,
    NeighborBlock as NeighborBlock,
    NeighborList as NeighborList,
    KNearest as KNearest,
    Pairs as Pairs,
)

# What neighborhoods say: normals, density, outliers, clusters.
from ._normals import normals as normals, PointNormals as PointNormals
from ._density import density as density
from ._outliers import outliers as outliers
from ._cluster import cluster as cluster

# Fewer points.
from ._downsample import downsample as downsample, Downsampled as Downsampled, cover as cover, Cover as Cover

# Clouds larger than memory: from file to file, and tile by tile.
from .streamed.process_file import process_file as process_file, ProcessedFile as ProcessedFile
from .streamed.load_tiles import load_tiles as load_tiles, PointTile as PointTile

# Clouds beside each other: registration and distances.
from ._register import register as register, Registration as Registration
from ._compare import (
    chamfer as chamfer,
    ChamferDistance as ChamferDistance,
    hausdorff as hausdorff,
    HausdorffDistance as HausdorffDistance,
    DirectedDistance as DirectedDistance,
)
