"""The voxels nearest to points: whether they are active, in grids of any type, and values of int64 grids."""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.nanovdb.read_voxel_kernels import grid_type_of, node_of
from geokit.volume.sampling.sample_kernels import has_voxels, nearest_voxel
from geokit.volume.tree.dense_rows_kernels import read_int64

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
    """Reads voxels of int64 grids as int64, because float64 samples round integers beyond 2^53."""
    i = first + wp.tid()
    u = to_index * (points[i] - origin)
    value = background
    if has_voxels(u):
        v = nearest_voxel(u)
        value = read_int64(volume, node_of(volume, grid_type_of(volume), v[0], v[1], v[2]), v[0], v[1], v[2])
    out_value[i] = value
