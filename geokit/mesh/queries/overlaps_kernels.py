"""Triangles that intersect boxes: first their number for each box, then the list."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.core.atomic_kernels import lower_to
from geokit.mesh.bvh.tree_kernels import BOX_CONSTANTS, SurfaceTree

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Relative to the sizes compared along a separating axis: five roundings on each side of the comparison, with slack.
BOX_GAP_ERROR = 3.0e-15


@wp.kernel
@cpp.native_item(
    "mesh/queries/overlaps.inl", "count_overlaps", SurfaceTree, **BOX_CONSTANTS, BOX_GAP_ERROR=BOX_GAP_ERROR
)
def count_overlaps_kernel(first: int): ...


@wp.kernel
@cpp.native_item(
    "mesh/queries/overlaps.inl", "list_overlaps", SurfaceTree, **BOX_CONSTANTS, BOX_GAP_ERROR=BOX_GAP_ERROR
)
def list_overlaps_kernel(first: int): ...


@wp.kernel
def first_inverted_kernel(
    first: int, lower: wp.array(dtype=wp.vec3d), upper: wp.array(dtype=wp.vec3d), out_row: wp.array(dtype=int)
):
    i = first + wp.tid()
    for k in range(3):
        if lower[i][k] > upper[i][k]:
            lower_to(out_row, 0, i)


@wp.kernel
def triangle_of_key_kernel(first: int, key: wp.array(dtype=wp.int64), out_triangle_id: wp.array(dtype=int)):
    i = first + wp.tid()
    out_triangle_id[i] = wp.int32(key[i] & wp.int64(0xFFFFFFFF))
