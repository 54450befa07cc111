"""First hits and occlusion of rays, watertight at shared edges and vertices."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.ray_walk_kernels import WALK_CONSTANTS
from geokit.mesh.bvh.tree_kernels import LEFT_OVER, UNDECIDED, SurfaceTree

wp.set_module_options({"enable_backward": False})

# Rays are processed in the caller's order: sorting them costs more than it gains, on a CPU and on a GPU.


@cpp.func_native("mesh/queries/raycast.inl", **WALK_CONSTANTS, CROSSINGS=False, UNORDERED=False)
def cast_rays(
    begin: int,
    end: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
    out_bad: wp.array(dtype=int),
): ...


@cpp.func_native("mesh/queries/raycast.inl", **WALK_CONSTANTS, CROSSINGS=False, UNORDERED=True)
def test_rays(
    begin: int,
    end: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_occluded: wp.array(dtype=wp.bool),
    out_bad: wp.array(dtype=int),
): ...


@wp.kernel
def raycast_kernel(
    first: int,
    group: int,
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
    begin = (first + wp.tid()) * group
    end = wp.min(begin + group, origins.shape[0])
    cast_rays(
        begin,
        end,
        origins,
        directions,
        tree,
        t_min,
        max_distance,
        out_t,
        out_triangle_id,
        out_barycentric,
        out_bad,
    )


@wp.kernel
def occluded_kernel(
    first: int,
    group: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_occluded: wp.array(dtype=wp.bool),
    out_bad: wp.array(dtype=int),
):
    begin = (first + wp.tid()) * group
    end = wp.min(begin + group, origins.shape[0])
    test_rays(begin, end, origins, directions, tree, t_min, max_distance, out_occluded, out_bad)


@wp.kernel
def raycast_undecided_kernel(
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
    """Second pass on CUDA, for the rays that the candidate search left undecided."""
    k = first + wp.tid()
    if out_triangle_id[k] == UNDECIDED:
        cast_rays(
            k,
            k + 1,
            origins,
            directions,
            tree,
            t_min,
            max_distance,
            out_t,
            out_triangle_id,
            out_barycentric,
            out_bad,
        )


@wp.func_native("return ((const unsigned char*)answers.data)[ray] == left_over;")
def is_left_over(answers: wp.array(dtype=wp.bool), ray: int, left_over: int) -> bool: ...


@wp.kernel
def occluded_left_over_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    wide: wp.array(dtype=int),
    out_occluded: wp.array(dtype=wp.bool),
    out_bad: wp.array(dtype=int),
):
    """The same for any hits."""
    k = first + wp.tid()
    if is_left_over(out_occluded, k, LEFT_OVER):
        test_rays(k, k + 1, origins, directions, tree, t_min, max_distance, out_occluded, out_bad)
