"""Traversal that visits the triangles of a surface whose boxes overlap a box, and the boxes it compares."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.cpp import cpp
from geokit.mesh.bvh.bvh2_packed_cuda_kernels import NODE_CONSTANTS
from geokit.mesh.bvh.bvh8_build_cpu_kernels import STACK
from geokit.mesh.bvh.tree_kernels import BOX_PADDING, SurfaceTree

wp.set_module_options({"enable_backward": False})

# Boxes end here, in local units: the mesh lies in [-1, 1], and the boxes of absent children lie beyond this.
FARTHEST = 1.0e18

LOCAL_BOX = "mesh/bvh/local_box.inl"


def box_walk(*files: str, defines: dict[str, str] | None = None, **constants: float) -> str:
    """The C++ text of a box traversal; ``files`` define low, high and visit, see box_walk.inl."""
    return cpp(
        "core/simd.inl",
        LOCAL_BOX,
        "mesh/bvh/load_node_bvh2.inl",
        *files,
        "mesh/bvh/box_walk.inl",
        defines=defines,
        **NODE_CONSTANTS,
        BOX_PADDING=BOX_PADDING,
        FARTHEST=FARTHEST,
        STACK=STACK,
        **constants,
    )


@wp.func_native(cpp(LOCAL_BOX, "mesh/bvh/slot_box.inl", BOX_PADDING=BOX_PADDING, FARTHEST=FARTHEST))
def slot_box(tree: SurfaceTree, slot: int, out_boxes: wp.array(dtype=wp.float32)): ...


@wp.kernel
def slot_boxes_kernel(first: int, tree: SurfaceTree, out_boxes: wp.array(dtype=wp.float32)):
    """For each block of eight slots their local boxes, six rows of eight: lower x y z, upper x y z."""
    slot_box(tree, first + wp.tid(), out_boxes)
