"""The slot of the nearest triangle, shared by all queries that need it."""

# mypy: ignore-errors
import numpy as np
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.bvh2_cuda_kernels import NODE_CONSTANTS
from geokit.mesh.bvh.bvh8_build_cpu_kernels import STACK
from geokit.mesh.bvh.leaf_planes_kernels import PLANE_ROWS
from geokit.mesh.bvh.tree_kernels import BOX_PADDING, SurfaceTree
from geokit.mesh.triangle.closest_kernels import SLIVER_SINE_SQUARED, closest_on_triangle, offset_from_triangle

wp.set_module_options({"enable_backward": False})

# Half the float32 error of a distance, in local units per unit of |q|_inf + 1: coordinates up to that size are rounded
# once (6e-8), subtracted, and projected on unit vectors that were rounded themselves. The worst case is 30 roundings,
# of which seldom more than 3 add up.
DISTANCE_ERROR = np.float32(2.0e-6)
# Queries farther out than this are searched in float64: their own rounding would leave most triangles possible.
FAR = 8.0
# Initial squared local distance without a search radius; any real one is smaller.
UNBOUNDED = 1.0e34
# Capacity for candidates that wait for float64. A query has two to six, unless it is equally far from many triangles.
CPU_CANDIDATES = 64
# The same in the local memory of a GPU thread.
CUDA_CANDIDATES = 8

_CONSTANTS = {
    **NODE_CONSTANTS,
    "SLIVER_SINE_SQUARED": SLIVER_SINE_SQUARED,
    "DISTANCE_ERROR": DISTANCE_ERROR,
    "FAR": FAR,
    "UNBOUNDED": UNBOUNDED,
    "BOX_PADDING": BOX_PADDING,
    "CPU_CANDIDATES": CPU_CANDIDATES,
    "CUDA_CANDIDATES": CUDA_CANDIDATES,
    "PLANE_ROWS": PLANE_ROWS,
    "STACK": STACK,
}


@cpp.func_native("mesh/bvh/nearest.inl", **_CONSTANTS, ANY_WITHIN=False)
def nearest_slot(tree: SurfaceTree, p: wp.vec3d, max_squared: wp.float64, seed: int) -> int:
    """Slot of the triangle nearest to p [world]; -1 if none is within the squared distance.

    ``seed`` is a slot that may be near, such as a neighbor's answer, or -1; it saves time and changes no answer.
    """
    ...


@cpp.func_native("mesh/bvh/nearest.inl", function="nearest_slot", **_CONSTANTS, ANY_WITHIN=True)
def slot_within(tree: SurfaceTree, p: wp.vec3d, max_squared: wp.float64, seed: int) -> int:
    """Slot of any triangle within the squared distance of p [world]; -1 if there is none.

    The choice depends on the device: on a GPU the first one in traversal order, on a CPU the nearest.
    """
    ...


@wp.func
def distance_from_slot(tree: SurfaceTree, slot: int, p: wp.vec3d) -> wp.float64:
    a = tree.corners[3 * slot]
    b = tree.corners[3 * slot + 1]
    c = tree.corners[3 * slot + 2]
    return wp.length(offset_from_triangle(p, a, b, c, closest_on_triangle(p, a, b, c)))
