"""Reads one voxel of a NanoVDB grid of any value type as float64.

Warp's own ``volume_lookup*`` and ``volume_sample*`` support nine value types and return 0 for all others, such as the
quantized ones. These functions read through PNanoVDB, which warp compiles into its kernels anyway. Finding a voxel's
node and reading the voxel are two steps, so that the voxels of a leaf share the walk down the tree. The value types are
listed in read_voxel.inl, with how their voxels are read.

The buffer is not checked here: the caller must reject grids with damaged offsets first.
"""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False})

FLOAT_TYPE = wp.constant(1)  # NanoVDB's number of float grids

vec8d = wp.types.vector(length=8, dtype=wp.float64)


@wp.func_native("return (int)wp::volume::get_grid_type(wp::volume::id_to_buffer(volume));")
def grid_type_of(volume: wp.uint64) -> int:
    """NanoVDB's code of the grid's value type."""
    ...


@cpp.func_native("volume/nanovdb/read_voxel.inl")
def node_of(volume: wp.uint64, grid_type: int, i: int, j: int, k: int) -> wp.uint64:
    """The leaf of a voxel, or the tile or background in its place, as an argument of read_voxel."""
    ...


@wp.func
def is_leaf(node: wp.uint64) -> bool:
    return (node & wp.uint64(1)) != wp.uint64(0)


# One overload for each family of value types, chosen by the type of the last argument.
for _family in (wp.float64, wp.vec3d, wp.vec4d):

    @cpp.func_native("volume/nanovdb/read_voxel.inl")
    def read_voxel(
        volume: wp.uint64, grid_type: int, node: wp.uint64, i: int, j: int, k: int, family: _family
    ) -> _family:
        """The value of a voxel, given the node from node_of."""
        ...


@cpp.func_native("volume/nanovdb/read_voxel.inl")
def read_float_leaf_cell(volume: wp.uint64, node: wp.uint64, i: int, j: int, k: int) -> vec8d:
    """The voxels (i, j, k) to (i + 1, j + 1, k + 1), k fastest, of a float grid; all must lie in one leaf."""
    ...


@wp.func
def read_separate(volume: wp.uint64, kind: int, n000: wp.uint64, i: int, j: int, k: int, family: Any):
    """As read_cell, given the node of the first voxel; the others share it unless a node border lies between them."""
    x = (i & 7) == 7
    y = (j & 7) == 7
    z = (k & 7) == 7
    n001 = n000
    n010 = n000
    n100 = n000
    if z:
        n001 = node_of(volume, kind, i, j, k + 1)
    if y:
        n010 = node_of(volume, kind, i, j + 1, k)
    if x:
        n100 = node_of(volume, kind, i + 1, j, k)
    n011 = n001
    n101 = n001
    n110 = n010
    if y:
        n011 = n010
        if z:
            n011 = node_of(volume, kind, i, j + 1, k + 1)
    if x:
        n101 = n100
        n110 = n100
        if z:
            n101 = node_of(volume, kind, i + 1, j, k + 1)
        if y:
            n110 = node_of(volume, kind, i + 1, j + 1, k)
    n111 = n011
    if x:
        n111 = n101
        if y:
            n111 = n110
            if z:
                n111 = node_of(volume, kind, i + 1, j + 1, k + 1)
    return (
        read_voxel(volume, kind, n000, i, j, k, family),
        read_voxel(volume, kind, n001, i, j, k + 1, family),
        read_voxel(volume, kind, n010, i, j + 1, k, family),
        read_voxel(volume, kind, n011, i, j + 1, k + 1, family),
        read_voxel(volume, kind, n100, i + 1, j, k, family),
        read_voxel(volume, kind, n101, i + 1, j, k + 1, family),
        read_voxel(volume, kind, n110, i + 1, j + 1, k, family),
        read_voxel(volume, kind, n111, i + 1, j + 1, k + 1, family),
    )


@wp.func
def read_cell(volume: wp.uint64, i: int, j: int, k: int, family: wp.float64):
    """The eight voxels (i, j, k) to (i + 1, j + 1, k + 1), k fastest."""
    kind = grid_type_of(volume)
    node = node_of(volume, kind, i, j, k)
    # Two thirds of all cells lie in one leaf: this path makes float grids 1.2 times as fast.
    if kind == FLOAT_TYPE and is_leaf(node) and (i & 7) < 7 and (j & 7) < 7 and (k & 7) < 7:
        c = read_float_leaf_cell(volume, node, i, j, k)
        return c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7]
    return read_separate(volume, kind, node, i, j, k, family)


@wp.func
def read_cell(volume: wp.uint64, i: int, j: int, k: int, family: Any):  # noqa: F811
    kind = grid_type_of(volume)
    return read_separate(volume, kind, node_of(volume, kind, i, j, k), i, j, k, family)
