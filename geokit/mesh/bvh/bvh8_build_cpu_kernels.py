"""Build of the CPU tree: binned surface area heuristic, eight children per node, leaves of eight triangles.

Warp's host builders run on one thread and read boxes through an index. Here the boxes themselves are moved, and all
threads build subtrees. The node numbers do not depend on the number of threads.
"""

# mypy: ignore-errors
import numpy as np
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.leaf_planes_kernels import FLAT, NOWHERE, PLANE_ROWS, SHORTEST

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Children of a node and triangles of a leaf: the lanes of one vector operation.
WIDTH = 8
# Bins per axis. More than 16 gain nothing on smooth meshes.
BINS = 16
# Least references of a range from which large ones are taken out, and the cost of the result relative to that of two
# splits.
TAKE_FROM = 512
GAIN = np.float32(0.95)
# Least references of a range that are put into several sets of bins.
SETS_FROM = 1024
# References whose sides are determined at once while a range is split: two blocks of them are in the cache.
AHEAD = 128
# From this depth on, ranges are halved by count, so that no input makes the tree deeper than the stack.
HALVING_DEPTH = 20
# Most nodes on the stack of a traversal: seven siblings on each level, for HALVING_DEPTH levels and for those that
# halving adds below them (2^31 triangles).
STACK = 256

# 32-bit words of a range that waits to be opened, with its depth.
WAITING_WORDS = 27

# Sentinel for an absent child, whose box is empty: 0, because the root is never a child.
NO_CHILD = 0
# Numbers of a reference, see bvh8_build_cpu.inl.
REFERENCE = 8
# Words of a ray leaf: nine rows of eight 16-bit numbers, then the HEAD; see bvh8_leaves_cpu.inl.
LEAF_WORDS = 48
HEAD = 36
# Ratio of a triangle's height to its longest edge, below which t is that of the plane; see ray.inl.
SLIVER = np.float32(1e-3)
# Rounding error of a ray across its direction, in local units: coordinates up to 2, differences up to 3, and slopes
# times those, each rounded by 6e-8, add up to 1.3e-6 in the worst case.
RAY_ERROR = 2.5e-6
# Least quantum: 1 / quantum, and its products with what RAY_ERROR leaves, stay small in float32.
LEAST_QUANTUM = 2.0**-30

_CONSTANTS = {
    "BINS": BINS,
    "TAKE_FROM": TAKE_FROM,
    "GAIN": GAIN,
    "AHEAD": AHEAD,
    "SETS_FROM": SETS_FROM,
    "WIDTH": WIDTH,
    "HALVING_DEPTH": HALVING_DEPTH,
    "NO_CHILD": NO_CHILD,
    "STACK": STACK,
    "WAITING_WORDS": WAITING_WORDS,
}
_LEAF_CONSTANTS = {
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


@wp.func
def rounded_down(x: wp.float64) -> wp.float32:
    """A float32 at most x, within one unit in the last place of the nearest one."""
    f = wp.float32(x)
    return f - wp.float32(1.2e-7) * wp.abs(f) - wp.float32(1.0e-30)


@wp.kernel
@cpp.native_item("mesh/bvh/bvh8_build_cpu.inl", "write_reference", **_CONSTANTS)
def references_kernel(first: int):
    """The reference of each triangle; ``begin`` has the first triangle of each tree, and their number."""


@wp.kernel
@cpp.native_item("mesh/bvh/bvh8_build_cpu.inl", "build_top", **_CONSTANTS)
def top_kernel(first: int):
    """One item is one tree: a single thread builds its top. ``begins`` and ``bases`` have one entry more."""


@wp.kernel
@cpp.native_item("mesh/bvh/bvh8_build_cpu.inl", "build_subtree", **_CONSTANTS)
def subtree_kernel(first: int): ...


@wp.kernel
def join_kernel(
    first: int,
    references: wp.array(dtype=wp.float32),
    subtree: wp.array(dtype=int),
    node_base: wp.array(dtype=int),
    size: wp.array(dtype=int),
    node_offset: wp.array(dtype=int),
    leaf_offset: wp.array(dtype=int),
    node_place: wp.array(dtype=int),
    leaf_place: wp.array(dtype=int),
    boxes: wp.array(dtype=wp.float32),
    children: wp.array(dtype=int),
    leaf_begin: wp.array(dtype=int),
    leaf_end: wp.array(dtype=int),
    out_boxes: wp.array(dtype=wp.float32),
    out_children: wp.array(dtype=int),
    out_slot_triangle: wp.array(dtype=int),
):
    """Move the nodes and leaves of one subtree to their final places.

    Numbers count from the tree's first node and leaf (``offset``), places from those of the first tree (``place``).
    """
    i = first + wp.tid()
    for n in range(size[2 * i]):
        source = node_base[i] + n
        target = node_place[i] + n
        for k in range(48):
            out_boxes[48 * target + k] = boxes[48 * source + k]
        for c in range(8):
            number = children[8 * source + c]
            if number > 0:
                number += node_offset[i]
            elif number < 0:
                number -= leaf_offset[i]
            out_children[8 * target + c] = number
    for n in range(size[2 * i + 1]):
        place = subtree[3 * i] + n
        slot = 8 * (leaf_place[i] + n)
        begin = leaf_begin[place]
        filled = leaf_end[place] - begin
        for c in range(8):
            triangle = int(-1)
            if c < filled:
                triangle = wp.cast(references[8 * (begin + c) + 3], int)
            out_slot_triangle[slot + c] = triangle


@wp.kernel
def link_top_kernel(
    first: int,
    size: wp.array(dtype=int),
    node_offset: wp.array(dtype=int),
    leaf_offset: wp.array(dtype=int),
    boxes: wp.array(dtype=wp.float32),
    children: wp.array(dtype=int),
    source: wp.array(dtype=int),
    place: wp.array(dtype=int),
    first_subtree: wp.array(dtype=int),
    out_boxes: wp.array(dtype=wp.float32),
    out_children: wp.array(dtype=int),
):
    """Copy a node of a top and link its children to the roots of their subtrees."""
    i = first + wp.tid()
    node = source[i]
    target = place[i]
    for k in range(48):
        out_boxes[48 * target + k] = boxes[48 * node + k]
    for c in range(8):
        number = children[8 * node + c]
        if number < 0:
            subtree = first_subtree[i] - 1 - number
            if size[2 * subtree] > 0:
                number = node_offset[subtree]
            else:
                number = -1 - leaf_offset[subtree]
        out_children[8 * target + c] = number


@wp.kernel
def block_boxes_kernel(
    first: int,
    slot_triangle: wp.array(dtype=int),
    corners: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    scale: wp.float64,
    out_boxes: wp.array(dtype=wp.float32),
):
    """The local box of the triangles in each block, rounded outward: lower x y z, upper x y z."""
    block = first + wp.tid()
    big = wp.float64(1.0e30)
    lower = wp.vec3d(big, big, big)
    upper = -lower
    for lane in range(8):
        slot = 8 * block + lane
        if slot_triangle[slot] >= 0:
            for k in range(3):
                p = (corners[3 * slot + k] - origin) / scale
                lower = wp.min(lower, p)
                upper = wp.max(upper, p)
    for k in range(3):
        out_boxes[6 * block + k] = rounded_down(lower[k])
        out_boxes[6 * block + 3 + k] = -rounded_down(-upper[k])


@wp.kernel
@cpp.native_item("mesh/bvh/bvh8_build_cpu.inl", "refit_nodes", **_CONSTANTS)
def refit_kernel(first: int):
    """Launched for one item: there are few nodes compared with triangles."""


@wp.kernel
@cpp.native_item("mesh/bvh/bvh8_leaves_cpu.inl", "place_block", **_LEAF_CONSTANTS)
def place_blocks_kernel(first: int):
    """One item is a block of slots; ``begin`` has the first slot of each tree, and their number."""


@wp.kernel
@cpp.native_item("mesh/bvh/bvh8_leaves_cpu.inl", "pack_leaf", **_LEAF_CONSTANTS)
def ray_leaves_kernel(first: int):
    """Pack the leaves of the same blocks into the form that rays read."""
