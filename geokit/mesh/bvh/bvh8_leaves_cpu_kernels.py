"""The leaves of the CPU's trees, eight triangles each: world corners and planes, and what rays read."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import numpy as np
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.leaf_planes_kernels import FLAT, NOWHERE, PLANE_ROWS, SHORTEST

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Triangles side by side in a block.
WIDTH = 8
# Words of a ray leaf: nine rows of eight 16-bit numbers, then the HEAD; see bvh8_leaves_cpu.inl.
LEAF_WORDS = 48
HEAD = 36
# Ratio of a triangle's height to its longest edge, below which t is that of the plane; see ray_triangle.inl.
SLIVER = np.float32(1e-3)
# Rounding error of a ray across its direction, in local units: coordinates up to 2, differences up to 3, and slopes
# times those, each rounded by 6e-8, add up to 1.3e-6 in the worst case.
RAY_ERROR = 2.5e-6
# Least quantum: 1 / quantum, and its products with what RAY_ERROR leaves, stay small in float32.
LEAST_QUANTUM = 2.0**-30

_CONSTANTS = {
    "WIDTH": WIDTH,
    "PLANE_ROWS": PLANE_ROWS,
    "NOWHERE": NOWHERE,
    "FLAT": FLAT,
    "SHORTEST": SHORTEST,
    "LEAF_WORDS": LEAF_WORDS,
    "HEAD": HEAD,
    "SLIVER": SLIVER,
    "RAY_ERROR": RAY_ERROR,
    "LEAST_QUANTUM": LEAST_QUANTUM,
}


@wp.kernel
@cpp.native_item("mesh/bvh/bvh8_leaves_cpu.inl", "place_block", **_CONSTANTS)
def place_blocks_kernel(first: int):
    """One item is a block of slots; ``begin`` has the first slot of each tree, and their number."""


@wp.kernel
@cpp.native_item("mesh/bvh/bvh8_leaves_cpu.inl", "pack_leaf", **_CONSTANTS)
def ray_leaves_kernel(first: int):
    """Pack the leaves of the same blocks into the form that rays read."""
