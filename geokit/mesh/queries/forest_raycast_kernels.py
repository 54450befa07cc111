"""First hits on many surfaces: each ray asks one of them."""

# mypy: ignore-errors
import warp as wp

from geokit.core.scan_kernels import part_of
from geokit.mesh.bvh.tree_kernels import SurfaceTree
from geokit.mesh.queries.raycast_kernels import cast_rays

wp.set_module_options({"enable_backward": False})


@wp.kernel
def forest_raycast_kernel(
    first: int,
    group: int,
    offsets: wp.array(dtype=int),
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    trees: wp.array(dtype=SurfaceTree),
    t_min: wp.float64,
    max_distance: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
    out_bad: wp.array(dtype=int),
):
    """As raycast_kernel; mesh m has the rays from ``offsets[m]`` on."""
    begin = (first + wp.tid()) * group
    end = wp.min(begin + group, origins.shape[0])
    mesh = part_of(offsets, begin)
    while begin < end:
        while offsets[mesh + 1] <= begin:
            mesh += 1
        stop = wp.min(end, offsets[mesh + 1])
        cast_rays(
            begin,
            stop,
            origins,
            directions,
            trees[mesh],
            t_min,
            max_distance,
            out_t,
            out_triangle_id,
            out_barycentric,
            out_bad,
        )
        begin = stop
