"""Exact queries for the user's own kernels: one closest point, ray, value or neighbor at a time, inside of a kernel."""

# Closest points, signs and rays of a mesh, by Surface.on_kernel.
from geokit.mesh.surfaces.user_kernels import (
    ClosestPoint,
    RayHit,
    Surface,
    closest_point,
    occluded,
    raycast,
    signed_distance,
)

# Neighbors of a point, by NeighborGrid.on_kernel.
from geokit.points.neighbors.user_kernels import Neighbor, NeighborGrid, first_neighbor, next_neighbor, sorted_point

# Values of a volume, by SparseVolume.on_kernel.
from geokit.volume.at_points.user_kernels import SparseVolume, gradient, sample

__all__ = [
    "ClosestPoint",
    "Neighbor",
    "NeighborGrid",
    "RayHit",
    "SparseVolume",
    "Surface",
    "closest_point",
    "first_neighbor",
    "gradient",
    "next_neighbor",
    "occluded",
    "raycast",
    "sample",
    "signed_distance",
    "sorted_point",
]
