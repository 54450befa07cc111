"""The slot of the nearest triangle, for every query that starts from it."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.mesh.bvh.bvh2_nearest_cuda_kernels import BINARY_NEAREST, BINARY_WITHIN
from geokit.mesh.bvh.bvh8_nearest_cpu_kernels import WIDE_NEAREST
from geokit.mesh.bvh.closest_on_triangle_kernels import CLOSEST_ON_TRIANGLE
from geokit.mesh.bvh.tree_kernels import SurfaceTree

wp.set_module_options({"enable_backward": False})


def _snippet(on_cuda):
    return f"""
    {CLOSEST_ON_TRIANGLE}
    #if defined(__CUDA_ARCH__)
    {on_cuda}
    #else
    {WIDE_NEAREST}
    #endif
"""


@wp.func_native(_snippet(BINARY_NEAREST))
def nearest_slot(tree: SurfaceTree, p: wp.vec3d, max_squared: wp.float64, seed: int) -> int:
    """Slot of the triangle nearest to p [world], -1 where none is within the squared distance.

    ``seed`` is a slot that may be near, such as a neighbour's answer, or -1; it saves time and changes no answer.
    """
    ...


@wp.func_native(_snippet(BINARY_WITHIN))
def slot_within(tree: SurfaceTree, p: wp.vec3d, max_squared: wp.float64, seed: int) -> int:
    """Slot of some triangle within the squared distance of p [world], -1 where there is none.

    Which one depends on the device: on a GPU the first that the walk meets, on a CPU the nearest.
    """
    ...
