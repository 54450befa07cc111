"""Reads rows of voxels along z, of a grid of any value type."""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.nanovdb.read_voxel_kernels import grid_type_of, node_of, read_voxel

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@cpp.func_native("volume/nanovdb/read_voxel.inl")
def copy_float_run():  # fmt: skip
    """Copies ``count`` voxels along z, all in the leaf or tile that node_of found for the first."""
    ...


@cpp.func_native("volume/nanovdb/read_voxel.inl")
def read_int64(volume: wp.uint64, node: wp.uint64, i: int, j: int, k: int) -> wp.int64:
    """The value of a voxel of an int64 grid, given the node from node_of."""
    ...


@wp.func
def voxel_in(volume: wp.uint64, kind: int, node: wp.uint64, i: int, j: int, k: int, family: wp.int64):
    return read_int64(volume, node, i, j, k)


@wp.func
def voxel_in(volume: wp.uint64, kind: int, node: wp.uint64, i: int, j: int, k: int, family: Any):  # noqa: F811
    return read_voxel(volume, kind, node, i, j, k, family)


@wp.kernel
def dense_kernel(
    first: int, volume: wp.uint64, lower: wp.vec3i, count_y: int, count_z: int, out_values: wp.array(dtype=Any)
):
    """Row ``r`` holds the voxels (x + r / count_y, y + r % count_y, z ... z + count_z - 1)."""
    row = first + wp.tid()
    i = lower[0] + row // count_y
    j = lower[1] + row % count_y
    kind = grid_type_of(volume)
    node = wp.uint64(0)
    begin = wp.int64(row) * wp.int64(count_z)
    for n in range(count_z):
        k = lower[2] + n
        # The voxels of a leaf share their node, and so do those of a tile, which is never smaller than a leaf.
        if n == 0 or (k & 7) == 0:
            node = node_of(volume, kind, i, j, k)
        at = begin + wp.int64(n)
        out_values[at] = voxel_in(volume, kind, node, i, j, k, out_values.dtype(0.0))


@wp.kernel
def float_kernel(
    first: int, volume: wp.uint64, lower: wp.vec3i, count_y: int, count_z: int, out_values: wp.array(dtype=wp.float32)
):
    """As dense_kernel, for float grids."""
    row = first + wp.tid()
    i = lower[0] + row // count_y
    j = lower[1] + row % count_y
    kind = grid_type_of(volume)
    begin = wp.int64(row) * wp.int64(count_z)
    n = int(0)
    while n < count_z:
        k = lower[2] + n
        run = wp.min(8 - (k & 7), count_z - n)
        copy_float_run(volume, node_of(volume, kind, i, j, k), i, j, k, run, out_values, begin + wp.int64(n))
        n += run


_SHARED = [int, wp.uint64, wp.vec3i, int, int]
DENSE_KERNELS = {
    components: wp.overload(dense_kernel, [*_SHARED, wp.array(dtype=dtype)])
    for components, dtype in ((1, wp.float64), (3, wp.vec3d), (4, wp.vec4d))
}
# Of int64 grids, without a way through float64.
exact_kernel = wp.overload(dense_kernel, [*_SHARED, wp.array(dtype=wp.int64)])
