"""First hits and occlusion of rays, watertight at shared edges and vertices."""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.ray_walk_kernels import WALK_CONSTANTS
from geokit.mesh.bvh.tree_kernels import LEFT_OVER, UNDECIDED, SurfaceTree

wp.set_module_options({"enable_backward": False})

# Rays are processed in the caller's order: sorting them costs more than it gains, on a CPU and on a GPU.


_CONSTANTS = {**WALK_CONSTANTS, "CROSSINGS": False, "UNDECIDED": UNDECIDED, "LEFT_OVER": LEFT_OVER}


@cpp.func_native("mesh/queries/raycast.inl", SurfaceTree, **_CONSTANTS, UNORDERED=False)
def cast_rays(): ...


@wp.kernel
@cpp.native_item("mesh/queries/raycast.inl", "cast_group", SurfaceTree, **_CONSTANTS, UNORDERED=False)
def raycast_kernel(first: int): ...


@wp.kernel
@cpp.native_item("mesh/queries/raycast.inl", "test_group", SurfaceTree, **_CONSTANTS, UNORDERED=True)
def occluded_kernel(first: int): ...


@wp.kernel
@cpp.native_item("mesh/queries/raycast.inl", "cast_undecided", SurfaceTree, **_CONSTANTS, UNORDERED=False)
def raycast_undecided_kernel(first: int):
    """Second pass on CUDA, for the rays that the candidate search left undecided."""


@wp.kernel
@cpp.native_item("mesh/queries/raycast.inl", "test_left_over", SurfaceTree, **_CONSTANTS, UNORDERED=True)
def occluded_left_over_kernel(first: int):
    """The same for any hits."""
