"""Unsigned distances of a tile's 512 voxels on the CPU: one tree walk per tile, then short lists of triangles.

Tiles whose list of triangles overflows are searched voxel by voxel.
"""

# mypy: ignore-errors
import numpy as np
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.bvh8_build_cpu_kernels import STACK
from geokit.mesh.bvh.leaf_planes_kernels import PLANE_ROWS
from geokit.mesh.bvh.nearest_kernels import DISTANCE_ERROR, FAR, UNBOUNDED, distance_from_slot, nearest_slot
from geokit.mesh.bvh.tree_kernels import SurfaceTree
from geokit.mesh.triangle.closest_kernels import SLIVER_SINE_SQUARED

# Unfused, float64 distances have the bits of every other search; float32 is fused where the C++ text says so.
wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# Most blocks in a tile's list; tiles with more are searched voxel by voxel. Half and twice as many were slower.
LIST = 256
# Half the diagonal of the cube of a brick's eight voxel centers, rounded up [voxels].
BRICK_RADIUS = np.float32(0.8660255)
# Factor on the step to a neighbor, so that the next search does not lose its answer to rounding.
STEP = np.float32(1.00001)


@cpp.func_native(
    "volume/band/distances_cpu.inl",
    SLIVER_SINE_SQUARED=SLIVER_SINE_SQUARED,
    DISTANCE_ERROR=DISTANCE_ERROR,
    FAR=FAR,
    UNBOUNDED=UNBOUNDED,
    PLANE_ROWS=PLANE_ROWS,
    STACK=STACK,
    LIST=LIST,
    BRICK_RADIUS=BRICK_RADIUS,
    STEP=STEP,
)
def tile_distances(
    tree: SurfaceTree, out_distance: wp.array2d(dtype=wp.float32), out_slot: wp.array2d(dtype=int)
) -> int:
    """Writes 512 distances minus ``offset``, cut off at ``reach``; returns 1 if the tile needs a search per voxel."""
    ...


@wp.kernel
def tile_distance_kernel(
    first: int,
    tiles: wp.array(dtype=wp.vec3i),
    translation: wp.vec3d,
    voxel_size: wp.float64,
    tree: SurfaceTree,
    reach: wp.float64,
    offset: wp.float64,
    out_distance: wp.array2d(dtype=wp.float32),
    out_slot: wp.array2d(dtype=int),
):
    """Unsigned distances of a tile's voxels, and the slots of their triangles if ``out_slot`` has room for them."""
    i = first + wp.tid()
    voxel = tiles[i] * 8
    if tile_distances(tree, voxel, translation, voxel_size, reach, offset, i, out_distance, out_slot) != 0:
        near = int(-1)
        bound = reach
        for n in range(512):
            index = voxel + wp.vec3i(n >> 6, (n >> 3) & 7, n & 7)
            p = wp.vec3d(wp.float64(index[0]), wp.float64(index[1]), wp.float64(index[2])) * voxel_size + translation
            if (n & 7) == 0:
                bound = reach
            slot = nearest_slot(tree, p, bound * bound, near)
            distance = reach
            if slot >= 0:
                near = slot
                distance = distance_from_slot(tree, slot, p)
            out_distance[i, n] = wp.float32(wp.min(distance, reach) - offset)
            if out_slot.shape[0] > 0:
                out_slot[i, n] = slot
            # A little more than one voxel, so that the next search does not lose its answer to rounding.
            bound = wp.min(reach, distance + wp.float64(1.000001) * voxel_size)
