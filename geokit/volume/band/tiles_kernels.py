"""Finds the 8^3 tiles near a surface by halving the cells near it."""

# mypy: ignore-errors
import warp as wp

from geokit.mesh.bvh.nearest_kernels import distance_from_slot, nearest_slot, slot_within
from geokit.mesh.bvh.tree_kernels import SurfaceTree

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# Half the diagonal of a cube of unit edge, rounded up.
HALF_DIAGONAL = wp.constant(wp.float64(0.86602540379))


@wp.kernel
def grid_cells_kernel(first: int, lowest: wp.vec3i, size: wp.vec3i, out_cells: wp.array(dtype=wp.vec3i)):
    """All cells of a box."""
    i = first + wp.tid()
    plane = i / size[2]
    out_cells[i] = lowest + wp.vec3i(plane / size[1], plane % size[1], i % size[2])


@wp.kernel
def near_cells_kernel(
    first: int,
    cells: wp.array(dtype=wp.vec3i),
    span: int,
    translation: wp.vec3d,
    voxel_size: wp.float64,
    tree: SurfaceTree,
    reach: wp.float64,
    hollow: wp.float64,
    out_near: wp.array(dtype=int),
):
    """1 for cells of ``span`` voxels whose bounding sphere of voxel centers comes within ``reach`` of the surface.

    0 if the whole sphere lies nearer to the surface than ``hollow``.
    """
    i = first + wp.tid()
    half = wp.float64(0.5) * wp.float64(span - 1)
    cell = cells[i]
    low = wp.vec3d(wp.float64(cell[0]), wp.float64(cell[1]), wp.float64(cell[2])) * wp.float64(span)
    center = (low + wp.vec3d(half, half, half)) * voxel_size + translation
    around = HALF_DIAGONAL * wp.float64(span - 1) * voxel_size
    radius = reach + around
    slot = slot_within(tree, center, radius * radius, -1)
    near = wp.where(slot >= 0, 1, 0)
    if slot >= 0 and hollow > wp.float64(0.0):
        slot = nearest_slot(tree, center, radius * radius, -1)
        if distance_from_slot(tree, slot, center) + around < hollow:
            near = int(0)
    out_near[i] = near


@wp.kernel
def halve_kernel(
    first: int,
    cells: wp.array(dtype=wp.vec3i),
    near: wp.array(dtype=int),
    ends: wp.array(dtype=int),
    out_cells: wp.array(dtype=wp.vec3i),
):
    """The eight halves of each near cell."""
    i = first + wp.tid()
    if near[i] != 0:
        for k in range(8):
            out_cells[8 * ends[i] - 8 + k] = cells[i] * 2 + wp.vec3i(k >> 2, (k >> 1) & 1, k & 1)


@wp.func
def place_in_order(coordinate: int, low: int, high: int) -> int:
    """Rank of an upper node's coordinate in the order of NanoVDB's keys, where negative ones come last."""
    rank = coordinate - wp.max(low, 0)
    if coordinate < 0:
        rank = coordinate - low + wp.max(high + 1, 0)
    return rank


@wp.kernel
def tile_keys_kernel(
    first: int,
    cells: wp.array(dtype=wp.vec3i),
    near: wp.array(dtype=int),
    ends: wp.array(dtype=int),
    low: wp.vec3i,
    high: wp.vec3i,
    out_key: wp.array(dtype=wp.int64),
    out_row: wp.array(dtype=int),
):
    """Sort key in a grid's order, and row, of each near tile.

    ``low`` and ``high`` are the first and last upper node. A key has 36 bits for the upper node, 15 for the lower node
    in it and 12 for the leaf in that.
    """
    i = first + wp.tid()
    if near[i] != 0:
        t = cells[i]
        upper = wp.int64(0)
        lower = int(0)
        leaf = int(0)
        for k in range(3):
            rank = place_in_order(t[k] >> 9, low[k], high[k])
            upper = upper * wp.int64(4096) + wp.int64(rank)
            lower = lower * 32 + ((t[k] >> 4) & 31)
            leaf = leaf * 16 + (t[k] & 15)
        at = ends[i] - 1
        out_key[at] = upper * wp.int64(134217728) + wp.int64(lower * 4096 + leaf)
        out_row[at] = i


@wp.kernel
def area_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    unit: wp.float64,
    out_area: wp.array(dtype=wp.float64),
):
    """Area of a triangle, in squares of ``unit``."""
    i = first + wp.tid()
    ab = (vertices[faces[3 * i + 1]] - vertices[faces[3 * i]]) / unit
    ac = (vertices[faces[3 * i + 2]] - vertices[faces[3 * i]]) / unit
    out_area[i] = wp.float64(0.5) * wp.length(wp.cross(ab, ac))
