"""Furthest point of a surface, always a vertex; the tree is pruned by the far corners of its boxes."""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.core.morton_order_kernels import prefetch_query
from geokit.mesh.bvh.bvh2_cuda_kernels import NODE_CONSTANTS
from geokit.mesh.bvh.bvh8_build_cpu_kernels import STACK
from geokit.mesh.bvh.tree_kernels import BOX_PADDING, SurfaceTree

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@cpp.func_native("mesh/queries/furthest.inl", **NODE_CONSTANTS, BOX_PADDING=BOX_PADDING, STACK=STACK)
def furthest_corner(tree: SurfaceTree, p: wp.vec3d) -> int:
    """The furthest corner from p, as three times the slot plus the corner."""
    ...


@wp.kernel
def furthest_point_kernel(
    first: int,
    order: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    out_points: wp.array(dtype=wp.vec3d),
    out_distance: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
):
    prefetch_query(points, order, first + wp.tid())
    i = order[first + wp.tid()]
    corner = furthest_corner(tree, points[i])
    found = tree.corners[corner]
    out_points[i] = found
    out_distance[i] = wp.length(found - points[i])
    out_triangle_id[i] = tree.slot_triangle[corner / 3]
