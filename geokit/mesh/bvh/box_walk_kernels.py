"""Traversal that visits the triangles of a surface whose boxes overlap a box, and the boxes it compares."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.bvh2_cuda_kernels import NODE_CONSTANTS
from geokit.mesh.bvh.bvh8_build_cpu_kernels import STACK
from geokit.mesh.bvh.tree_kernels import SurfaceTree

wp.set_module_options({"enable_backward": False})

# Boxes end here, in local units: the mesh lies in [-1, 1], and the boxes of absent children lie beyond this.
FARTHEST = 1.0e18

BOX_CONSTANTS = {**NODE_CONSTANTS, "FARTHEST": FARTHEST, "STACK": STACK}


@cpp.func_native("mesh/bvh/box_walk.inl", **BOX_CONSTANTS)
def slot_box(tree: SurfaceTree, slot: int, out_boxes: wp.array(dtype=wp.float32)): ...


@wp.kernel
def slot_boxes_kernel(first: int, tree: SurfaceTree, out_boxes: wp.array(dtype=wp.float32)):
    """For each block of eight slots their local boxes, six rows of eight: lower x y z, upper x y z."""
    slot_box(tree, first + wp.tid(), out_boxes)
