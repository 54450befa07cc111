"""Any hits on CUDA: a float32 traversal that most hits end by themselves, then float64 tests of what is doubtful."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.bvh2_ray_candidates_cuda_kernels import CANDIDATE_CONSTANTS
from geokit.mesh.bvh.ray_walk_kernels import SHORTEST_DIRECTION, is_usable, length_in_t
from geokit.mesh.bvh.tree_kernels import SurfaceTree

wp.set_module_options({"enable_backward": False})

# Doubtful triangles of a ray: those around an edge or a vertex that it aims at.
CANDIDATES = 16
# Register limit of a GPU thread; see docs/design/launches-and-memory.md.
REGISTERS = 64


@cpp.func_native(
    "mesh/bvh/ray_candidates_cuda.inl", SurfaceTree, **CANDIDATE_CONSTANTS, CANDIDATES=CANDIDATES, ANY_HIT=True
)
def any_hit(): ...


@wp.kernel(cuda_max_registers=REGISTERS, grid_stride=False)
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
