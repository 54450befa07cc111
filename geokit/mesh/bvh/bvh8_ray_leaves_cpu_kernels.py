"""Leaves that rays read, eight triangles in 16-bit numbers, from the planes of the leaves."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import numpy as np
import warp as wp

from geokit.core.cpp import cpp
from geokit.mesh.bvh.leaf_planes_kernels import PLANE_ROWS

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Words of a ray leaf: nine rows of eight 16-bit numbers, then the HEAD; see pack_ray_leaf_bvh8_cpu.inl.
LEAF_WORDS = 48
HEAD = 36
# Ratio of a triangle's height to its longest edge, below which t is that of the plane; see refine_sliver.inl.
SLIVER = np.float32(1e-3)
# Rounding error of a ray across its direction, in local units: coordinates up to 2, differences up to 3, and slopes
# times those, each rounded by 6e-8, add up to 1.3e-6 in the worst case.
RAY_ERROR = 2.5e-6
# Least quantum: 1 / quantum, and its products with what RAY_ERROR leaves, stay small in float32.
LEAST_QUANTUM = 2.0**-30


@wp.func_native(
    cpp(
        "core/simd.inl",
        "mesh/bvh/pack_ray_leaf_bvh8_cpu.inl",
        PLANE_ROWS=PLANE_ROWS,
        LEAF_WORDS=LEAF_WORDS,
        HEAD=HEAD,
        SLIVER=SLIVER,
        RAY_ERROR=RAY_ERROR,
        LEAST_QUANTUM=LEAST_QUANTUM,
    )
)
def pack_leaf(
    block: int,
    slot_triangle: wp.array(dtype=int),
    corners: wp.array(dtype=wp.vec3d),
    leaves: wp.array(dtype=wp.float32),
    origin: wp.vec3d,
    scale: wp.float64,
    out_leaves: wp.array(dtype=wp.float32),
): ...


@wp.kernel
def ray_leaves_kernel(
    first: int,
    slot_triangle: wp.array(dtype=int),
    corners: wp.array(dtype=wp.vec3d),
    leaves: wp.array(dtype=wp.float32),
    origin: wp.vec3d,
    scale: wp.float64,
    out_leaves: wp.array(dtype=wp.float32),
):
    """Pack the leaves into the form that rays read."""
    pack_leaf(first + wp.tid(), slot_triangle, corners, leaves, origin, scale, out_leaves)
