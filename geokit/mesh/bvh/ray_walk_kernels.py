"""Traversals of rays over a prepared surface, and the constants that both devices share."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import numpy as np
import warp as wp

from geokit.mesh.bvh.bvh2_cuda_kernels import NODE_CONSTANTS
from geokit.mesh.bvh.bvh8_build_cpu_kernels import STACK
from geokit.mesh.bvh.bvh8_leaves_cpu_kernels import HEAD, LEAF_WORDS, SLIVER
from geokit.mesh.bvh.leaf_planes_kernels import PLANE_ROWS

wp.set_module_options({"enable_backward": False})

# Shorter directions would lose digits as denormal numbers inside the edge functions.
SHORTEST_DIRECTION = 1e-150
# A ray that starts farther out than this, in local units, is tested from where it enters the cube around the mesh.
NEAR_START = 2.0
# Rounding error of a box or a ray, in local units: coordinates up to NEAR_START are rounded by 1.2e-7, and four such
# roundings add up in a slab test.
BOX_MARGIN = 1.0e-6
# Padding of the node boxes for rays on CUDA [local]: twice the rounding error of a ray.
RAY_PADDING = 2.0 * BOX_MARGIN
# Rounding error of a point on the ray in a triangle's own frame, whose axes are rounded too; see DISTANCE_ERROR. The
# length of a ray has the same slack.
PLANE_MARGIN = 8.0e-6
# The same for hits that float64 need not decide: over twice the worst case, see surely_hit in ray_walk_cpu.inl. And how
# far out such rays may start: farther ones have fewer digits.
SURE_MARGIN = 4.0e-5
SURE_START = 1.0e6
# Length of rays without an end, in local units.
ENDLESS = 1.0e30
# Smaller direction components (relative to the largest) count as this: their reciprocals must not overflow.
LEAST_COMPONENT = 1.0e-18
# Rays in flight on a CPU thread.
IN_FLIGHT = 32
# Rays are prefetched this far ahead of their set-up: the hardware prefetcher stops at page boundaries.
AHEAD = 32

RAY_CONSTANTS = {
    **NODE_CONSTANTS,
    "NEAR_START": NEAR_START,
    "PLANE_MARGIN": np.float32(PLANE_MARGIN),
    "ENDLESS": np.float32(ENDLESS),
    "LEAST_COMPONENT": np.float32(LEAST_COMPONENT),
    "SLIVER": SLIVER,
    "LEAF_WORDS": LEAF_WORDS,
    "HEAD": HEAD,
}
# Those of walk_rays, beside CROSSINGS and UNORDERED.
WALK_CONSTANTS = {
    **RAY_CONSTANTS,
    "SHORTEST_DIRECTION": SHORTEST_DIRECTION,
    "BOX_MARGIN": np.float32(BOX_MARGIN),
    "IN_FLIGHT": IN_FLIGHT,
    "AHEAD": AHEAD,
    "PLANE_ROWS": PLANE_ROWS,
    "SURE_MARGIN": np.float32(SURE_MARGIN),
    "SURE_START": SURE_START,
    "STACK": STACK,
}


@wp.func_native(
    """
    const wp::vec_t<3, wp::float64> none = (start - start) + (direction - direction);
    return largest >= shortest && none[0] + none[1] + none[2] == 0.0;
"""
)
def is_usable(start: wp.vec3d, direction: wp.vec3d, largest: wp.float64, shortest: wp.float64) -> bool:
    """Whether all numbers are finite (x - x is zero, unless x is infinite or NaN) and the direction is long enough."""
    ...


@wp.func
def length_in_t(max_distance: wp.float64, direction: wp.vec3d) -> wp.float64:
    t_max = max_distance
    if wp.isfinite(max_distance):
        t_max = max_distance / wp.length(direction)
    return t_max
