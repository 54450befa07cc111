# The cloud itself, and files.
from ._io import PointCloud as PointCloud, load as load, save as save, load_rays as load_rays

# Neighbors: a grid is prepared once and queried often.
from ._neighbors import (
    NeighborGrid as NeighborGrid,
    Neighbors as Neighbors,
    NeighborBlock as NeighborBlock,
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

# Clouds beside each other: registration and distances.
from ._register import register as register, Registration as Registration
from ._compare import (
    chamfer as chamfer,
    ChamferDistance as ChamferDistance,
    hausdorff as hausdorff,
    HausdorffDistance as HausdorffDistance,
    DirectedDistance as DirectedDistance,
)
