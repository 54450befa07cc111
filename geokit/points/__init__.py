"""Point sets: neighbours, normals, subsets, clusters, registration, and reading and writing point files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geokit._lazy import make_lazy

if TYPE_CHECKING:
    from geokit.points.cluster import cluster
    from geokit.points.compare import ChamferDistance, DirectedDistance, HausdorffDistance, chamfer, hausdorff
    from geokit.points.density import density
    from geokit.points.downsample import Cover, Downsampled, cover, downsample
    from geokit.points.io import PointCloud, load, load_rays, save
    from geokit.points.neighbors import KNearest, NeighborBlock, NeighborGrid, Neighbors, Pairs
    from geokit.points.normals import PointNormals, normals
    from geokit.points.outliers import outliers
    from geokit.points.register import Registration, register

__all__ = [
    "ChamferDistance",
    "Cover",
    "DirectedDistance",
    "Downsampled",
    "HausdorffDistance",
    "KNearest",
    "NeighborBlock",
    "NeighborGrid",
    "Neighbors",
    "Pairs",
    "PointCloud",
    "PointNormals",
    "Registration",
    "chamfer",
    "cluster",
    "cover",
    "density",
    "downsample",
    "hausdorff",
    "load",
    "load_rays",
    "normals",
    "outliers",
    "register",
    "save",
]

make_lazy(
    __name__,
    {
        "ChamferDistance": "geokit.points.compare",
        "DirectedDistance": "geokit.points.compare",
        "Cover": "geokit.points.downsample",
        "Downsampled": "geokit.points.downsample",
        "cover": "geokit.points.downsample",
        "HausdorffDistance": "geokit.points.compare",
        "KNearest": "geokit.points.neighbors",
        "NeighborBlock": "geokit.points.neighbors",
        "NeighborGrid": "geokit.points.neighbors",
        "Neighbors": "geokit.points.neighbors",
        "Pairs": "geokit.points.neighbors",
        "PointCloud": "geokit.points.io",
        "PointNormals": "geokit.points.normals",
        "Registration": "geokit.points.register",
        "chamfer": "geokit.points.compare",
        "cluster": "geokit.points.cluster",
        "density": "geokit.points.density",
        "downsample": "geokit.points.downsample",
        "hausdorff": "geokit.points.compare",
        "load": "geokit.points.io",
        "load_rays": "geokit.points.io",
        "normals": "geokit.points.normals",
        "outliers": "geokit.points.outliers",
        "register": "geokit.points.register",
        "save": "geokit.points.io",
    },
)
