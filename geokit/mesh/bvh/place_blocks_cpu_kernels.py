"""The triangles of the CPU's trees in slot order: their world corners, and their planes eight at a time."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.cpp import cpp
from geokit.core.scan_kernels import part_of
from geokit.mesh.bvh.leaf_planes_kernels import FLAT, NOWHERE, PLANE_ROWS, SHORTEST

wp.set_module_options({"enable_backward": False})

# Triangles side by side in a block.
WIDTH = 8

_CONSTANTS = {"WIDTH": WIDTH, "PLANE_ROWS": PLANE_ROWS, "NOWHERE": NOWHERE, "FLAT": FLAT, "SHORTEST": SHORTEST}


@wp.func_native(cpp("core/simd.inl", "mesh/bvh/place_block_bvh8_cpu.inl", **_CONSTANTS))
def place_block(
    block: int,
    slot_triangle: wp.array(dtype=int),
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    origin: wp.vec3d,
    scale: wp.float64,
    out_corners: wp.array(dtype=wp.vec3d),
    out_leaves: wp.array(dtype=wp.float32),
): ...


@wp.kernel
def place_blocks_kernel(
    first: int,
    begin: wp.array(dtype=int),
    slot_triangle: wp.array(dtype=int),
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    origins: wp.array(dtype=wp.vec3d),
    scales: wp.array(dtype=wp.float64),
    out_corners: wp.array(dtype=wp.vec3d),
    out_leaves: wp.array(dtype=wp.float32),
):
    """One item is a block of slots; ``begin`` has the first slot of each tree, and their number."""
    block = first + wp.tid()
    tree = part_of(begin, WIDTH * block)
    place_block(block, slot_triangle, vertices, faces, origins[tree], scales[tree], out_corners, out_leaves)
