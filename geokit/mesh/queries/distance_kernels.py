"""Pairs of triangles of two surfaces, one of which stands in poses: the nearest (one for each leaf, then the points of
the nearest of all), or all within a margin."""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.core.atomic_kernels import lower_to
from geokit.mesh.bvh.bvh2_cuda_kernels import NODE_CONSTANTS
from geokit.mesh.bvh.bvh8_build_cpu_kernels import STACK
from geokit.mesh.bvh.nearest_kernels import nearest_slot
from geokit.mesh.bvh.tree_kernels import BOX_PADDING, SurfaceTree
from geokit.mesh.queries.intersecting_kernels import PAIR_CONSTANTS
from geokit.mesh.triangle.closest_kernels import SLIVER_SINE_SQUARED, closest_on_triangle, offset_from_triangle

# Without fused multiply-adds a GPU gives the same bits as a CPU, and so the same pair.
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# A bound from a vertex is widened by more than the rounding by which the pair's own distance may exceed it.
WIDENED = wp.constant(wp.float64(1.0 + 1e-9))
# Share of the size within which distances are known, and points and planes touch where no predicate decides.
CONTACT_ERROR = 1e-12

_CONSTANTS = {
    **NODE_CONSTANTS,
    **PAIR_CONSTANTS,
    "SLIVER_SINE_SQUARED": SLIVER_SINE_SQUARED,
    "BOX_PADDING": BOX_PADDING,
    "STACK": STACK,
    "CONTACT_ERROR": CONTACT_ERROR,
}


@cpp.func_native("mesh/queries/distance.inl", SurfaceTree, **_CONSTANTS)
def nearest_pair() -> wp.float64:
    """Write the nearest pair of one item if it is as near as the limit; returns the smaller of both."""
    ...


@wp.kernel
def bound_by_corners_kernel(
    first: int,
    items: int,
    surface: SurfaceTree,
    stride: int,
    linear: wp.array(dtype=wp.mat33d),
    shift: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    unit: wp.array(dtype=wp.float64),
    out_bound: wp.array(dtype=wp.int64),
):
    """Lower the bound of each pose to the distance of one corner of each ``stride``-th slot, ``items`` a pose.

    The bound is the bits of a number that is not negative: they sort as the numbers do.
    """
    pose = (first + wp.tid()) / items
    slot = (first + wp.tid()) % items * stride
    if surface.slot_triangle[slot] < 0:
        return
    p = linear[pose] * surface.corners[3 * slot] + shift[pose]
    other = nearest_slot(tree, p, wp.float64(wp.inf), -1)
    a = tree.corners[3 * other]
    b = tree.corners[3 * other + 1]
    c = tree.corners[3 * other + 2]
    offset = unit[pose] * offset_from_triangle(p, a, b, c, closest_on_triangle(p, a, b, c))
    lower_to(out_bound, pose, wp.cast(wp.dot(offset, offset) * WIDENED, wp.int64))


@wp.kernel
def nearest_pair_kernel(
    first: int,
    items: int,
    surface: SurfaceTree,
    linear: wp.array(dtype=wp.mat33d),
    shift: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    slot_boxes: wp.array(dtype=wp.float32),
    unit: wp.array(dtype=wp.float64),
    out_bound: wp.array(dtype=wp.int64),
    out_squared: wp.array(dtype=wp.float64),
    out_slots: wp.array(dtype=int),
):
    """The bound of a pose falls while its ``items`` are at work: it saves time and changes no answer."""
    row = first + wp.tid()
    pose = row / items
    limit = wp.cast(out_bound[pose], wp.float64)
    best = nearest_pair(
        row % items,
        surface,
        linear[pose],
        shift[pose],
        tree,
        slot_boxes,
        unit[pose],
        limit,
        row,
        out_squared,
        out_slots,
    )
    lower_to(out_bound, pose, wp.cast(best, wp.int64))


@wp.kernel
@cpp.native_item("mesh/queries/distance.inl", "points_of_pair", SurfaceTree, **_CONSTANTS)
def points_of_pair_kernel(first: int): ...


@wp.kernel
@cpp.native_item("mesh/queries/distance.inl", "list_within", SurfaceTree, **_CONSTANTS)
def list_within_kernel(first: int): ...
