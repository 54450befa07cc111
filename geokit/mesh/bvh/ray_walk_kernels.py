"""What all traversals of rays over a prepared surface share, and the first pass of first and any hits on CUDA.

That pass is a float32 traversal that collects a few candidates, then float64 tests of those: float64 tests during the
traversal would make threads wait for each other at every triangle. A triangle that the ray hits well inside ends the
search behind it. One that it hits within the margin of an edge does not, and is decided together with the other
candidates.
"""

# mypy: ignore-errors
import numpy as np
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.bvh2_cuda_kernels import NODE_CONSTANTS
from geokit.mesh.bvh.bvh8_build_cpu_kernels import HEAD, LEAF_WORDS, SLIVER, STACK
from geokit.mesh.bvh.leaf_planes_kernels import PLANE_ROWS
from geokit.mesh.bvh.tree_kernels import LEFT_OVER, NO_CANDIDATE, UNDECIDED, SurfaceTree

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
    "SHORTEST_DIRECTION": SHORTEST_DIRECTION,
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
    "BOX_MARGIN": np.float32(BOX_MARGIN),
    "IN_FLIGHT": IN_FLIGHT,
    "AHEAD": AHEAD,
    "PLANE_ROWS": PLANE_ROWS,
    "SURE_MARGIN": np.float32(SURE_MARGIN),
    "SURE_START": SURE_START,
    "STACK": STACK,
}

# Candidates of a ray: the triangle that it hits first and, near an edge or a vertex, those around it. With 16, one of
# four million rays had too many among 3 million triangles, and the second pass took a sixth of the first one's time.
CANDIDATES = 32
# The same for any hits: most of these end the search, and what is left is around an edge or a vertex.
ANY_HIT_CANDIDATES = 16
# Register limits of a GPU thread; see docs/design/launches-and-memory.md.
REGISTERS = 40
ANY_HIT_REGISTERS = 48
# Flag bit in a candidate's slot; slot numbers are below it.
IS_SLIVER = 1 << 30
# First entry of a ray's candidate list: it hits something.
SURE = wp.constant(-3)

PASS_CONSTANTS = {
    **RAY_CONSTANTS,
    "CROSSINGS": False,
    "IS_SLIVER": IS_SLIVER,
    "NO_CANDIDATE": NO_CANDIDATE,
    "UNDECIDED": UNDECIDED,
    "SURE": SURE,
    "LEFT_OVER": LEFT_OVER,
}


@wp.kernel(cuda_max_registers=REGISTERS, grid_stride=False)
@cpp.native_item(
    "mesh/bvh/ray_candidates_cuda.inl",
    "first_hit",
    SurfaceTree,
    **PASS_CONSTANTS,
    CANDIDATES=CANDIDATES,
    ANY_HIT=False,
)
def first_hit_kernel(first: int):
    """First hits; rays with too many candidates, or from too far away for float32, become UNDECIDED."""


@wp.kernel(cuda_max_registers=ANY_HIT_REGISTERS, grid_stride=False)
@cpp.native_item(
    "mesh/bvh/ray_candidates_cuda.inl",
    "any_hit",
    SurfaceTree,
    **PASS_CONSTANTS,
    CANDIDATES=ANY_HIT_CANDIDATES,
    ANY_HIT=True,
)
def any_hit_kernel(first: int):
    """Whether rays hit anything; those with too many candidates, or from too far away for float32, are LEFT_OVER."""
