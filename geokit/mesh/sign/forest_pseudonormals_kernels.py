"""Signs of distances from many surfaces by pseudonormals."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.scan_kernels import part_of
from geokit.mesh.sign.pseudonormals_kernels import Pseudonormals, pseudonormal

# The same bits as pseudonormal_sign_kernel.
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})


@wp.kernel
def forest_pseudonormal_kernel(
    first: int,
    offsets: wp.array(dtype=int),
    asked: wp.array(dtype=wp.bool),
    points: wp.array(dtype=wp.vec3d),
    closest: wp.array(dtype=wp.vec3d),
    triangle_id: wp.array(dtype=int),
    barycentric: wp.array(dtype=wp.vec3d),
    tables: wp.array(dtype=Pseudonormals),
    outside: wp.array(dtype=wp.float64),
    out_distance: wp.array(dtype=wp.float64),
):
    """As pseudonormal_sign_kernel; mesh m has the queries from ``offsets[m]`` on."""
    i = first + wp.tid()
    mesh = part_of(offsets, i)
    if asked[mesh]:
        triangle = triangle_id[i]
        if triangle >= 0 and out_distance[i] < outside[mesh]:
            normal = pseudonormal(tables[mesh], triangle, barycentric[i])
            if wp.dot(points[i] - closest[i], normal) < wp.float64(0.0):
                out_distance[i] = -out_distance[i]
