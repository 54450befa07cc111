"""Tests which voxels of a band lie inside, by pseudonormal or by winding number."""

# mypy: ignore-errors
import warp as wp

from geokit.mesh.bvh.nearest_kernels import nearest_slot
from geokit.mesh.bvh.tree_kernels import SurfaceTree
from geokit.mesh.bvh.winding_kernels import WindingTree, is_inside
from geokit.mesh.sign.pseudonormals_kernels import Pseudonormals, pseudonormal
from geokit.mesh.triangle.closest_kernels import closest_on_triangle, offset_from_triangle
from geokit.volume.band.signs_kernels import set_in_row, unset_in_row, voxel_position

# Unfused, a GPU gives the same bits as a CPU, and ties between triangles resolve alike.
wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# A tile's center is at most 6.07 voxels beyond the band's reach, and its voxels at most 6.07 voxels from the center.
WITHIN_TILE = wp.constant(wp.float64(12.2))
# Factor on a known distance, which float32 has rounded, to get a search radius.
ROUNDED = wp.constant(wp.float64(1.000001))


@wp.struct
class BandVoxels:
    """The voxels of a band before they are signed."""

    # Coordinates of all tiles, and the tile of each leaf.
    tiles: wp.array(dtype=wp.vec3i)
    rows: wp.array(dtype=int)
    # Position of index 0, and the voxels' edge length [world].
    translation: wp.vec3d
    voxel_size: wp.float64
    # Unsigned distances of the tiles' voxels, cut off at ``reach`` [world].
    distance: wp.array2d(dtype=wp.float32)
    reach: wp.float64


@wp.func
def position_of(voxels: BandVoxels, row: int, voxel: int) -> wp.vec3d:
    return voxel_position(voxels.tiles[row], voxel, voxels.translation, voxels.voxel_size)


@wp.func
def search_radius(voxels: BandVoxels, row: int, voxel: int) -> wp.float64:
    """A radius that contains the nearest triangle of a voxel, also if its distance is cut off at ``reach``."""
    distance = voxels.distance[row, voxel]
    radius = wp.float64(distance) * ROUNDED
    if distance >= wp.float32(voxels.reach):
        radius = voxels.reach * ROUNDED + WITHIN_TILE * voxels.voxel_size
    return radius


@wp.func
def is_inside_by_pseudonormal(
    tree: SurfaceTree, tables: Pseudonormals, voxels: BandVoxels, row: int, voxel: int
) -> wp.bool:
    """Whether a voxel lies behind the nearest face, edge or vertex, by its pseudonormal."""
    p = position_of(voxels, row, voxel)
    radius = search_radius(voxels, row, voxel)
    slot = nearest_slot(tree, p, radius * radius, -1)
    behind = bool(False)
    if slot >= 0:
        a = tree.corners[3 * slot]
        b = tree.corners[3 * slot + 1]
        c = tree.corners[3 * slot + 2]
        barycentric = closest_on_triangle(p, a, b, c)
        normal = pseudonormal(tables, tree.slot_triangle[slot], barycentric)
        behind = wp.dot(offset_from_triangle(p, a, b, c, barycentric), normal) < wp.float64(0.0)
    return behind


@wp.kernel
def regions_by_pseudonormal_kernel(
    first: int,
    regions: int,
    voxels: BandVoxels,
    seeds: wp.array(dtype=int),
    tree: SurfaceTree,
    tables: Pseudonormals,
    out_inside: wp.array(dtype=wp.bool),
):
    """Tests the voxel of each region, if there is one, by pseudonormal."""
    i = first + wp.tid()
    if seeds[i] >= 0:
        out_inside[i] = is_inside_by_pseudonormal(tree, tables, voxels, voxels.rows[i / regions], seeds[i])


@wp.kernel
def voxels_by_pseudonormal_kernel(
    first: int,
    span: int,
    known: wp.array2d(dtype=wp.uint64),
    voxels: BandVoxels,
    tree: SurfaceTree,
    tables: Pseudonormals,
    out_inside: wp.array2d(dtype=wp.uint64),
):
    """Tests the voxels of unknown side in ``span`` rows of eight by pseudonormal."""
    for item in range(span * (first + wp.tid()), span * (first + wp.tid() + 1)):
        leaf = item >> 6
        left = unset_in_row(known, leaf, item & 63)
        if left != 0:
            row = voxels.rows[leaf]
            found = int(0)
            for b in range(8):
                if ((left >> b) & 1) != 0:
                    if is_inside_by_pseudonormal(tree, tables, voxels, row, 8 * (item & 63) + b):
                        found = found | (1 << b)
            set_in_row(out_inside, leaf, item & 63, found)


@wp.kernel
def regions_by_winding_kernel(
    first: int,
    regions: int,
    voxels: BandVoxels,
    seeds: wp.array(dtype=int),
    tree: SurfaceTree,
    winding: WindingTree,
    empty: wp.float64,
    out_inside: wp.array(dtype=wp.bool),
):
    """Tests the voxel of each region, if there is one, by winding number."""
    i = first + wp.tid()
    if seeds[i] >= 0:
        p = position_of(voxels, voxels.rows[i / regions], seeds[i])
        out_inside[i] = is_inside(tree, winding, empty, p)


@wp.func
def inside_in_run(
    tree: SurfaceTree,
    winding: WindingTree,
    empty: wp.float64,
    voxels: BandVoxels,
    row: int,
    begin: int,
    end: int,
) -> int:
    """Bits 0 to ``end - begin`` of a run of voxels: its ends are tested, and the place between where the side changes.

    The surface must not cross the run, so that the side changes at most once, unless an open mesh is all around it.
    """
    low = begin
    high = end
    at_low = is_inside(tree, winding, empty, position_of(voxels, row, begin))
    at_high = at_low
    if end > begin:
        at_high = is_inside(tree, winding, empty, position_of(voxels, row, end))
    if at_low == at_high:
        low = end
    while high - low > 1:
        middle = (low + high) / 2
        if is_inside(tree, winding, empty, position_of(voxels, row, middle)) == at_low:
            low = middle
        else:
            high = middle
    below = (2 << (low - begin)) - 1
    bits = int(0)
    if at_low:
        bits = below
    if at_high:
        bits = bits | (((2 << (end - begin)) - 1) & ~below)
    return bits


@wp.kernel
def voxels_by_winding_kernel(
    first: int,
    span: int,
    known: wp.array2d(dtype=wp.uint64),
    voxels: BandVoxels,
    tree: SurfaceTree,
    winding: WindingTree,
    empty: wp.float64,
    out_inside: wp.array2d(dtype=wp.uint64),
):
    """Tests the voxels of unknown side in ``span`` rows of eight by winding number.

    Consecutive voxels beyond reach are one run, because the surface does not cross it.
    """
    far = wp.float32(voxels.reach)
    for item in range(span * (first + wp.tid()), span * (first + wp.tid() + 1)):
        leaf = item >> 6
        left = unset_in_row(known, leaf, item & 63)
        if left != 0:
            row = voxels.rows[leaf]
            start = 8 * (item & 63)
            found = int(0)
            b = int(0)
            while b < 8:
                end = b
                if ((left >> b) & 1) != 0:
                    if voxels.distance[row, start + b] >= far:
                        while (
                            end < 7
                            and ((left >> (end + 1)) & 1) != 0
                            and (voxels.distance[row, start + end + 1] >= far)
                        ):
                            end += 1
                    found = found | (inside_in_run(tree, winding, empty, voxels, row, start + b, start + end) << b)
                b = end + 1
            set_in_row(out_inside, leaf, item & 63, found)
