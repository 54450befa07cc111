"""Unsigned distances of a band's voxels on CUDA: one thread per voxel, bounded by its brick's nearest triangle."""

# mypy: ignore-errors
import warp as wp

from geokit.mesh.bvh.nearest_kernels import distance_from_slot, nearest_slot
from geokit.mesh.bvh.tree_kernels import SurfaceTree

# Unfused, a GPU gives the same bits as a CPU, and ties between triangles resolve alike.
wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# Half the diagonal of the cube of a brick's 4^3 voxel centers, rounded up [voxels].
BRICK_RADIUS = wp.constant(wp.float64(2.5980763))


@wp.kernel
def brick_kernel(
    first: int,
    tiles: wp.array(dtype=wp.vec3i),
    translation: wp.vec3d,
    voxel_size: wp.float64,
    tree: SurfaceTree,
    reach: wp.float64,
    out_slot: wp.array(dtype=int),
):
    """The slot nearest to the center of each of a tile's eight bricks of 4^3 voxels; -1 if none is near."""
    i = first + wp.tid()
    tile = tiles[i >> 3] * 2 + wp.vec3i((i >> 2) & 1, (i >> 1) & 1, i & 1)
    half = wp.float64(1.5)
    index = wp.vec3d(wp.float64(4 * tile[0]), wp.float64(4 * tile[1]), wp.float64(4 * tile[2]))
    p = (index + wp.vec3d(half, half, half)) * voxel_size + translation
    radius = reach + BRICK_RADIUS * voxel_size
    out_slot[i] = nearest_slot(tree, p, radius * radius, -1)


@wp.kernel
def voxel_kernel(
    first: int,
    tiles: wp.array(dtype=wp.vec3i),
    translation: wp.vec3d,
    voxel_size: wp.float64,
    tree: SurfaceTree,
    reach: wp.float64,
    offset: wp.float64,
    bricks: wp.array(dtype=int),
    start: int,
    out_distance: wp.array2d(dtype=wp.float32),
    out_slot: wp.array2d(dtype=int),
):
    """Distance of a voxel minus ``offset``, cut off at ``reach``; its brick's triangle bounds the search.

    ``start`` is the tile of the first item, because a band may have more voxels than a launch can count.
    """
    i = first + wp.tid()
    row = start + (i >> 9)
    # Threads run brick by brick, so that neighboring threads walk the same nodes.
    brick = (i >> 6) & 7
    x = 4 * (brick >> 2) + ((i >> 4) & 3)
    y = 4 * ((brick >> 1) & 1) + ((i >> 2) & 3)
    z = 4 * (brick & 1) + (i & 3)
    voxel = 64 * x + 8 * y + z
    distance = reach
    slot = bricks[8 * row + brick]
    if slot >= 0:
        tile = tiles[row]
        index = wp.vec3d(wp.float64(8 * tile[0] + x), wp.float64(8 * tile[1] + y), wp.float64(8 * tile[2] + z))
        p = index * voxel_size + translation
        # The radius includes the brick's triangle, so the search finds it again if it is the nearest.
        radius = wp.min(reach, distance_from_slot(tree, slot, p) * wp.float64(1.000000000001))
        slot = nearest_slot(tree, p, radius * radius, slot)
        if slot >= 0:
            distance = wp.min(reach, distance_from_slot(tree, slot, p))
    out_distance[row, voxel] = wp.float32(distance - offset)
    if out_slot.shape[0] > 0:
        out_slot[row, voxel] = slot
