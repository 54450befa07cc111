"""Signs of distances from many surfaces by winding numbers."""

# mypy: ignore-errors
import warp as wp

from geokit.core.scan_kernels import part_of
from geokit.mesh.bvh.tree_kernels import SurfaceTree
from geokit.mesh.bvh.winding_kernels import WindingTree, is_inside, winding_number_at

wp.set_module_options({"enable_backward": False})


@wp.kernel
def forest_winding_kernel(
    first: int,
    offsets: wp.array(dtype=int),
    asked: wp.array(dtype=wp.bool),
    points: wp.array(dtype=wp.vec3d),
    trees: wp.array(dtype=SurfaceTree),
    windings: wp.array(dtype=WindingTree),
    empty: wp.array(dtype=wp.float64),
    out_distance: wp.array(dtype=wp.float64),
):
    """As sign_kernel; mesh m has the queries from ``offsets[m]`` on."""
    i = first + wp.tid()
    mesh = part_of(offsets, i)
    if asked[mesh]:
        if is_inside(trees[mesh], windings[mesh], empty[mesh], points[i]):
            out_distance[i] = -out_distance[i]


@wp.kernel
def forest_missed_kernel(
    first: int,
    offsets: wp.array(dtype=int),
    asked: wp.array(dtype=wp.bool),
    points: wp.array(dtype=wp.vec3d),
    triangle_id: wp.array(dtype=int),
    trees: wp.array(dtype=SurfaceTree),
    windings: wp.array(dtype=WindingTree),
    empty: wp.array(dtype=wp.float64),
    out_distance: wp.array(dtype=wp.float64),
):
    """As missed_sign_kernel: queries that found no triangle within the search radius."""
    i = first + wp.tid()
    mesh = part_of(offsets, i)
    if asked[mesh] and triangle_id[i] < 0:
        if winding_number_at(trees[mesh], windings[mesh], empty[mesh], points[i]) > wp.float64(0.5):
            out_distance[i] = -out_distance[i]
