"""First and any hits on CUDA: a float32 traversal that collects a few candidates, then float64 tests of those.

Float64 tests during the traversal would make threads wait for each other at every triangle. A triangle that the ray
hits well inside ends the search behind it. One that it hits within the margin of an edge does not, and is decided
together with the other candidates.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.ray_walk_kernels import RAY_CONSTANTS, SHORTEST_DIRECTION, is_usable, length_in_t
from geokit.mesh.bvh.tree_kernels import LEFT_OVER, NO_CANDIDATE, UNDECIDED, SurfaceTree

wp.set_module_options({"enable_backward": False})

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

CANDIDATE_CONSTANTS = {
    **RAY_CONSTANTS,
    "CROSSINGS": False,
    "IS_SLIVER": IS_SLIVER,
    "NO_CANDIDATE": NO_CANDIDATE,
    "UNDECIDED": UNDECIDED,
    "SURE": SURE,
    "LEFT_OVER": LEFT_OVER,
}


@cpp.func_native(
    "mesh/bvh/ray_candidates_cuda.inl", SurfaceTree, **CANDIDATE_CONSTANTS, CANDIDATES=CANDIDATES, ANY_HIT=False
)
def first_hit(): ...


@cpp.func_native(
    "mesh/bvh/ray_candidates_cuda.inl", SurfaceTree, **CANDIDATE_CONSTANTS, CANDIDATES=ANY_HIT_CANDIDATES, ANY_HIT=True
)
def any_hit(): ...


@wp.kernel(cuda_max_registers=REGISTERS, grid_stride=False)
def first_hit_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
    out_bad: wp.array(dtype=int),
):
    """First hits; rays with too many candidates, or from too far away for float32, become UNDECIDED."""
    ray = first + wp.tid()
    start = origins[ray]
    direction = directions[ray]
    largest = wp.max(wp.max(wp.abs(direction[0]), wp.abs(direction[1])), wp.abs(direction[2]))
    if is_usable(start, direction, largest, wp.float64(SHORTEST_DIRECTION)):
        t_max = length_in_t(max_distance, direction)
        first_hit(tree, start, direction, t_min, t_max, ray, out_t, out_triangle_id, out_barycentric, out_bad)
    else:
        # The host rejects the whole batch and names the row.
        out_bad[0] = 1
        out_triangle_id[ray] = NO_CANDIDATE


@wp.kernel(cuda_max_registers=ANY_HIT_REGISTERS, grid_stride=False)
def any_hit_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_occluded: wp.array(dtype=wp.bool),
    out_bad: wp.array(dtype=int),
):
    """Whether rays hit anything; those with too many candidates, or from too far away for float32, are LEFT_OVER."""
    ray = first + wp.tid()
    start = origins[ray]
    direction = directions[ray]
    largest = wp.max(wp.max(wp.abs(direction[0]), wp.abs(direction[1])), wp.abs(direction[2]))
    if is_usable(start, direction, largest, wp.float64(SHORTEST_DIRECTION)):
        any_hit(tree, start, direction, t_min, length_in_t(max_distance, direction), ray, out_occluded, out_bad)
    else:
        out_bad[0] = 1  # the host rejects the whole batch and names the row
