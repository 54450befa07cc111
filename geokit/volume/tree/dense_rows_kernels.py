"""Reads rows of voxels along z, of a grid of any value type."""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.nanovdb.read_voxel_kernels import grid_type_of, node_of, read_voxel

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# The readers for every type give float64, which rounds integers beyond 2^53: those of 64 bits have one of their own.
_INT64_SNIPPET = """
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_address_t at = { node & ~1ull };
    const pnanovdb_leaf_handle_t leaf = { at };
    const pnanovdb_coord_t ijk = { i, j, k };
    const unsigned n = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk));
    if ((node & 1u) == 0u) return pnanovdb_read_int64(buf, at);
    return pnanovdb_read_int64(buf, pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_INT64, buf, leaf, n));
"""


# Rows of a float leaf lie as they do in the array.
_FLOAT_RUN_SNIPPET = """
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_address_t at = { node & ~1ull };
    const pnanovdb_leaf_handle_t leaf = { at };
    const pnanovdb_coord_t ijk = { i, j, k };
    float* target = out_values.data + to;
    if ((node & 1u) == 0u) {
        const float value = pnanovdb_read_float(buf, at);
        for (int n = 0; n < count; ++n) target[n] = value;
        return;
    }
    const unsigned first_voxel = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk));
    for (int n = 0; n < count; ++n) {
        target[n] = pnanovdb_read_float(
            buf, pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_FLOAT, buf, leaf, first_voxel + (unsigned)n));
    }
"""


@wp.func_native(_FLOAT_RUN_SNIPPET)
def copy_float_run(
    volume: wp.uint64, node: wp.uint64, i: int, j: int, k: int, count: int, out_values: wp.array(dtype=wp.float32),
    to: wp.int64,
):  # fmt: skip
    """Copies ``count`` voxels along z, all of them in the leaf or tile that node_of found for the first."""
    ...


@wp.func_native(_INT64_SNIPPET)
def read_int64(volume: wp.uint64, node: wp.uint64, i: int, j: int, k: int) -> wp.int64:
    """The value of a voxel of an int64 grid, by the node that node_of found for it."""
    ...


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
        # Voxels of a leaf share their node; so do those of a tile, which is never smaller.
        if n == 0 or (k & 7) == 0:
            node = node_of(volume, kind, i, j, k)
        at = begin + wp.int64(n)
        out_values[at] = read_voxel(volume, kind, node, i, j, k, out_values.dtype(0.0))


@wp.kernel
def exact_kernel(
    first: int, volume: wp.uint64, lower: wp.vec3i, count_y: int, count_z: int, out_values: wp.array(dtype=wp.int64)
):
    """As dense_kernel, for int64 grids."""
    row = first + wp.tid()
    i = lower[0] + row // count_y
    j = lower[1] + row % count_y
    kind = grid_type_of(volume)
    node = wp.uint64(0)
    begin = wp.int64(row) * wp.int64(count_z)
    for n in range(count_z):
        k = lower[2] + n
        if n == 0 or (k & 7) == 0:
            node = node_of(volume, kind, i, j, k)
        at = begin + wp.int64(n)
        out_values[at] = read_int64(volume, node, i, j, k)


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
