"""Tests whether the voxels nearest to points are active, in grids of any type."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.volume.sampling.sample_kernels import has_voxels, nearest_voxel

wp.set_module_options({"enable_backward": False})


@cpp.func_native("volume/nanovdb/read_voxel.inl")
def is_active(volume: wp.uint64, i: int, j: int, k: int) -> bool:
    """Whether a voxel, or the tile that covers it, is active."""
    ...


@wp.kernel
def active_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    out_active: wp.array(dtype=wp.bool),
):
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    active = bool(False)
    if has_voxels(u):
        v = nearest_voxel(u)
        active = is_active(volume, v[0], v[1], v[2])
    out_active[i] = active
