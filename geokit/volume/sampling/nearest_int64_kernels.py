"""Reads the nearest voxels of int64 grids as int64, because float64 samples round integers beyond 2^53."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.nanovdb.read_voxel_kernels import grid_type_of, node_of
from geokit.volume.sampling.sample_kernels import has_voxels, nearest_voxel
from geokit.volume.tree.dense_rows_kernels import read_int64

wp.set_module_options({"enable_backward": False})


@wp.kernel
def nearest_int64_kernel(
    first: int,
    volume: wp.uint64,
    points: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: wp.int64,
    out_value: wp.array(dtype=wp.int64),
):
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    value = background
    if has_voxels(u):
        v = nearest_voxel(u)
        value = read_int64(volume, node_of(volume, grid_type_of(volume), v[0], v[1], v[2]), v[0], v[1], v[2])
    out_value[i] = value
