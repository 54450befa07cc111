"""Surface nets: a vertex for each sheet of the surface in a cell, a quad for each crossed edge of the grid.

An item is ``span`` planes of 64 cells in the crossed blocks: one plane on a GPU; a block of eight planes on a CPU,
where each item has a cost. The number of a cell's first vertex is the number of sheets before it in its plane. A quad
belongs to the cell whose upper corner (1, 1, 1) is the end of its edge, so that its four cells lie in the cell's own
block or in blocks above.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.isosurface import surface_nets_cases_kernels
from geokit.volume.isosurface.cells_kernels import Cells, value_at

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

vec8d = wp.types.vector(length=8, dtype=wp.float64)

# Least distance [voxels] of a crossing from the ends of its edge. Without it, a voxel equal to the isovalue would give
# coincident vertices and triangles without area. It is well below the resolution of a float32 voxel, and still distinct
# in float64 at index 2^30.
END = 1.0e-6

NUMBERS = {**surface_nets_cases_kernels.NUMBERS, "END": END}


@wp.struct
class Nets:
    """The sheets of the surface in the planes of the crossed blocks."""

    table: wp.array(dtype=wp.uint32)  # loop_table
    sums: wp.array(dtype=wp.uint32)  # sum_table
    flips: wp.array(dtype=wp.uint64)  # for each plane, bit mask of its cells with a joined face
    records: wp.array(dtype=wp.uint64)  # RECORD per plane: bit masks of its cells by number of sheets
    base: wp.array(dtype=int)  # first vertex of each plane


@cpp.func_native("volume/isosurface/surface_nets.inl", **NUMBERS)
def place_vertices(cells: Cells, nets: Nets) -> wp.uint64:
    """Places the vertices of a plane's cells; returns a bit mask of those left because a corner lies in a tile."""
    ...


@cpp.func_native("volume/isosurface/surface_nets.inl", **NUMBERS)
def place_vertex(cells: Cells, nets: Nets, value: vec8d):
    """Places the vertices of one cell from the values at its corners, relative to the isovalue."""
    ...


@wp.kernel
def vertices_kernel(
    first: int,
    span: int,
    cells: Cells,
    nets: Nets,
    isovalue: wp.float64,
    linear: wp.mat33d,
    offset: wp.vec3d,
    out_vertex: wp.array(dtype=wp.vec3d),
):
    for plane in range(span * (first + wp.tid()), span * (first + wp.tid() + 1)):
        left = place_vertices(cells, nets, plane, linear, offset, out_vertex)
        if left != wp.uint64(0):
            corner = cells.origin[cells.crossed[plane / 8]]
            for bit in range(64):
                if (left >> wp.uint64(bit)) & wp.uint64(1) != wp.uint64(0):
                    value = vec8d()
                    for c in range(8):
                        i = corner[0] + plane % 8 + c / 4
                        j = corner[1] + bit / 8 + (c / 2) % 2
                        k = corner[2] + bit % 8 + c % 2
                        value[c] = value_at(cells.volume, i, j, k) - isovalue
                    place_vertex(cells, nets, plane, bit, value, linear, offset, out_vertex)


@wp.kernel
@cpp.native_item("volume/isosurface/surface_nets.inl", "place_all_quads", Cells, Nets, **NUMBERS)
def quads_kernel(first: int): ...
