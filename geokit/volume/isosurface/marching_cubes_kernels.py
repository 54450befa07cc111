"""Marching cubes: a vertex on each crossed edge of the grid, and the triangles of each cell's case between them.

An item is ``span`` planes of 64 cells in the crossed blocks: one plane on a GPU; a block of eight planes on a CPU,
where each item has a cost. A cell owns the edges that start at its lowest corner, so all vertices of its triangles
belong to cells of its own block or of blocks above. Edges without an active voxel at either end have no vertex, and
triangles that would need it are left out.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.isosurface.cells_kernels import Cells, value_at

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Words of a plane's record: crossed edges along x, y and z.
RECORD = wp.constant(3)
# Least distance [voxels] of a crossing from the ends of its edge. Without it, a voxel equal to the isovalue would give
# coincident vertices and triangles without area. It is well below the resolution of a float32 voxel, and still distinct
# in float64 at index 2^30.
END = 1.0e-6


@cpp.func_native("volume/isosurface/marching_cubes.inl", END=END)
def place_vertices(cells: Cells) -> bool:
    """Places the vertices of a plane's edges; returns False if some are left because an end lies in a tile."""
    ...


@cpp.func_native("volume/isosurface/marching_cubes.inl", END=END)
def place_vertex(cells: Cells):
    """Places the vertex of one edge from the values at its ends, relative to the isovalue."""
    ...


@wp.kernel
@cpp.native_item("volume/isosurface/marching_cubes.inl", "count_planes", Cells, END=END)
def count_kernel(first: int): ...


@wp.kernel
def vertices_kernel(
    first: int,
    span: int,
    cells: Cells,
    records: wp.array(dtype=wp.uint64),
    base: wp.array(dtype=int),
    isovalue: wp.float64,
    linear: wp.mat33d,
    offset: wp.vec3d,
    out_vertex: wp.array(dtype=wp.vec3d),
):
    for plane in range(span * (first + wp.tid()), span * (first + wp.tid() + 1)):
        if not place_vertices(cells, plane, records, base, linear, offset, out_vertex):
            volume = cells.volume
            block = cells.crossed[plane / 8]
            corner = cells.origin[block]
            for axis in range(3):
                word = records[RECORD * plane + axis]
                for bit in range(64):
                    if (word >> wp.uint64(bit)) & wp.uint64(1) != wp.uint64(0):
                        i = corner[0] + plane % 8
                        j = corner[1] + bit / 8
                        k = corner[2] + bit % 8
                        low = value_at(volume, i, j, k) - isovalue
                        high = value_at(volume, i + int(axis == 0), j + int(axis == 1), k + int(axis == 2)) - isovalue
                        place_vertex(cells, plane, bit, axis, low, high, records, base, linear, offset, out_vertex)


@wp.kernel
@cpp.native_item("volume/isosurface/marching_cubes.inl", "place_all_triangles", Cells, END=END)
def triangles_kernel(first: int): ...
