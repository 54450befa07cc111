"""The handle through which kernels access a prepared surface."""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.core.atomic_kernels import add_to
from geokit.mesh.bvh.bvh2_cuda_kernels import NODE_CONSTANTS
from geokit.mesh.bvh.bvh8_build_cpu_kernels import STACK

wp.set_module_options({"enable_backward": False})

# Local coordinates lie in [-1, 1] and are rounded to float32 by at most 2^-25 (half a unit in the last place) per axis;
# 2e-7 covers three axes and the rounding of the box distance itself, about twice over.
BOX_PADDING = 2.0e-7
# Boxes end here, in local units: the mesh lies in [-1, 1], and the boxes of absent children lie beyond this.
FARTHEST = 1.0e18

BOX_CONSTANTS = {**NODE_CONSTANTS, "FARTHEST": FARTHEST, "STACK": STACK}

# First entry of a ray's candidate list: no candidate; and: the complete traversal must decide.
NO_CANDIDATE = wp.constant(-1)
UNDECIDED = wp.constant(-2)
# In place of a bool: the same.
LEFT_OVER = wp.constant(2)


@wp.struct
class SurfaceTree:
    """A surface as kernels see it: its tree has eight children per node on a CPU, two on CUDA.

    A slot is a position in a leaf: triangles that are near each other in space have slots that are near each other.
    """

    # Local frame: local = (world - origin) / scale lies in [-1, 1].
    origin: wp.vec3d
    scale: wp.float64
    # World corners of the triangle in each slot, three per slot, and its number; NaN and -1 for empty slots.
    corners: wp.array(dtype=wp.vec3d)
    slot_triangle: wp.array(dtype=int)
    # CPU: for each node the boxes of its eight children, six rows of eight (lower x, y, z, upper x, y, z), local.
    # CUDA: the nodes of bvh2_cuda_kernels.
    boxes: wp.array(dtype=wp.float32)
    # CPU: eight per node: the number of an inner node, or -1 - block for a leaf of eight slots. Node 0 is the root.
    # CUDA: one entry, the root, in the form of a child reference.
    children: wp.array(dtype=int)
    # For each block PLANE_ROWS rows of eight: the triangles in their own frames; see leaf_planes_kernels.
    leaves: wp.array(dtype=wp.float32)
    # The leaves for rays, on the CPU only: LEAF_WORDS words per block; see bvh8_leaves_cpu.inl.
    ray_leaves: wp.array(dtype=wp.float32)
    # For any hits only: slots of the few triangles that hold much of the area, the widest first.
    wide: wp.array(dtype=int)


@wp.kernel
def gather_corners_kernel(
    first: int,
    slot_triangle: wp.array(dtype=int),
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    out_corners: wp.array(dtype=wp.vec3d),
):
    slot = first + wp.tid()
    triangle = slot_triangle[slot]
    for k in range(3):
        if triangle >= 0:
            out_corners[3 * slot + k] = vertices[faces[3 * triangle + k]]
        else:
            none = wp.float64(wp.nan)
            out_corners[3 * slot + k] = wp.vec3d(none, none, none)


@wp.kernel
def area_kernel(first: int, corners: wp.array(dtype=wp.vec3d), out_area: wp.array(dtype=wp.float64)):
    """Twice the area of the triangle in each slot [world^2]; 0 for empty slots."""
    slot = first + wp.tid()
    a = corners[3 * slot]
    area = wp.length(wp.cross(corners[3 * slot + 1] - a, corners[3 * slot + 2] - a))
    out_area[slot] = wp.max(area, wp.float64(0.0))


@wp.kernel
def list_wide_kernel(
    first: int,
    area: wp.array(dtype=wp.float64),
    least: wp.float64,
    out_count: wp.array(dtype=int),
    out_slot: wp.array(dtype=int),
    out_area: wp.array(dtype=wp.float64),
):
    """Slots whose triangle has at least so much area, and their areas, in any order, as far as there is room."""
    slot = first + wp.tid()
    if area[slot] >= least:
        place = add_to(out_count, 0, 1)
        if place < out_slot.shape[0]:
            out_slot[place] = slot
            out_area[place] = area[slot]


@cpp.func_native("mesh/bvh/box_walk.inl", **BOX_CONSTANTS)
def slot_box(tree: SurfaceTree, slot: int, out_boxes: wp.array(dtype=wp.float32)): ...


@wp.kernel
def slot_boxes_kernel(first: int, tree: SurfaceTree, out_boxes: wp.array(dtype=wp.float32)):
    """For each block of eight slots their local boxes, six rows of eight: lower x y z, upper x y z."""
    slot_box(tree, first + wp.tid(), out_boxes)
