"""Moves the vertices of surface nets to the intersection of the tangent planes at the crossings in their cell.

A voxel's plane is the set where its first-order Taylor expansion takes the isovalue; for a distance field it is the
plane through the voxel's closest point. Differences are taken on the side on which the field is straighter, because
next to an edge of the surface the other side belongs to another face.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.isosurface.cells_kernels import Cells, Tree, leaf_at, value_at
from geokit.volume.isosurface.surface_nets_kernels import NUMBERS, Nets
from geokit.volume.nanovdb.read_voxel_kernels import grid_type_of, is_leaf, node_of

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Blocks around a block.
AROUND = wp.constant(27)
# A vertex does not move in directions whose eigenvalue (sum of squared normals) is below this share of the largest. The
# two faces of an edge of 160 degrees give 0.03, a smooth surface with a radius of 10 voxels gives 0.003.
FLAT = 0.02
# Sweeps of Jacobi's method: each squares the off-diagonal rest; four bring a 3 x 3 matrix to 1e-15.
SWEEPS = 4
# The planes are not trusted if the interpolant puts the surface more than this many voxels away from their
# intersection: the interpolant rounds off a cube's edges by up to 0.5 voxel, its corners by up to 0.6.
FAR = 0.7
# A gradient shorter than this times the values that it is computed from has no direction.
NO_SLOPE = 1.0e-6


@wp.kernel
def around_kernel(
    first: int,
    cells: Cells,
    tree: Tree,
    isovalue: wp.float64,
    out_leaf: wp.array(dtype=int),
    out_tile: wp.array(dtype=wp.float64),
):
    """The 27 blocks around each crossed block: leaf numbers, or -1 and the tile's value minus the isovalue."""
    item = first + wp.tid()
    side = item % AROUND
    corner = cells.origin[cells.crossed[item / AROUND]]
    i = corner[0] + 8 * (side / 9 - 1)
    j = corner[1] + 8 * ((side / 3) % 3 - 1)
    k = corner[2] + 8 * (side % 3 - 1)
    node = node_of(cells.volume, grid_type_of(cells.volume), i, j, k)
    if is_leaf(node):
        out_leaf[item] = leaf_at(cells, tree, node)
        out_tile[item] = wp.float64(0.0)
    else:
        out_leaf[item] = -1
        out_tile[item] = value_at(cells.volume, i, j, k) - isovalue


@wp.kernel
@cpp.native_item(
    "volume/isosurface/dual_contouring.inl",
    "sharpen_planes",
    FLAT=FLAT,
    SWEEPS=SWEEPS,
    FAR=FAR,
    NO_SLOPE=NO_SLOPE,
    **NUMBERS,
)
def sharpen_kernel(first: int, cells: Cells, nets: Nets): ...
