"""Closest points on many surfaces: each query asks one of them."""

# mypy: ignore-errors
import warp as wp

from geokit.core.scan_kernels import part_of
from geokit.mesh.bvh.tree_kernels import SurfaceTree
from geokit.mesh.queries.closest_point_kernels import REGISTERS, put_closest

# The same bits as closest_point_kernel.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel(cuda_max_registers=REGISTERS)
def forest_closest_kernel(
    first: int,
    group: int,
    offsets: wp.array(dtype=int),
    asked: wp.array(dtype=wp.bool),
    points: wp.array(dtype=wp.vec3d),
    trees: wp.array(dtype=SurfaceTree),
    max_distance: wp.float64,
    out_points: wp.array(dtype=wp.vec3d),
    out_distance: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
    out_nonfinite: wp.array(dtype=int),
):
    """As closest_point_kernel; mesh m has the queries from ``offsets[m]`` on. Only meshes that are asked answer."""
    begin = (first + wp.tid()) * group
    mesh = part_of(offsets, begin)
    slot = int(-1)
    for i in range(begin, wp.min(begin + group, points.shape[0])):
        while offsets[mesh + 1] <= i:
            mesh += 1
            slot = int(-1)
        if asked[mesh]:
            slot = put_closest(
                i,
                points[i],
                trees[mesh],
                max_distance,
                slot,
                out_points,
                out_distance,
                out_triangle_id,
                out_barycentric,
                out_nonfinite,
            )
