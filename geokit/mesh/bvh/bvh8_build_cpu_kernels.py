"""Build of the CPU tree: binned surface area heuristic, eight children per node.

Warp's host builders run on one thread and read boxes through an index. Here the boxes themselves are moved, and all
threads build subtrees. The node numbers do not depend on the number of threads.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.cpp import cpp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Children of a node and triangles of a leaf: the lanes of one vector operation.
WIDTH = 8
# Bins per axis. More than 16 gain nothing on smooth meshes.
BINS = 16
# From this depth on, ranges are halved by count, so that no input makes the tree deeper than the stack.
HALVING_DEPTH = 20
# Most nodes on the stack of a traversal: seven siblings on each level, for HALVING_DEPTH levels and for those that
# halving adds below them (2^31 triangles).
STACK = 256

# A reference is a box and its triangle: lower x y z, triangle, upper x y z, unused.
REFERENCE = 8


@wp.func
def rounded_down(x: wp.float64) -> wp.float32:
    """A float32 at most x, within one unit in the last place of the nearest one."""
    f = wp.float32(x)
    return f - wp.float32(1.2e-7) * wp.abs(f) - wp.float32(1.0e-30)


@wp.kernel
def references_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    origin: wp.vec3d,
    scale: wp.float64,
    out_references: wp.array(dtype=wp.float32),
):
    """The local box of each triangle, rounded outward."""
    i = first + wp.tid()
    a = vertices[faces[3 * i]] - origin
    b = vertices[faces[3 * i + 1]] - origin
    c = vertices[faces[3 * i + 2]] - origin
    lower = wp.min(wp.min(a, b), c) / scale
    upper = wp.max(wp.max(a, b), c) / scale
    for k in range(3):
        out_references[8 * i + k] = rounded_down(lower[k])
        out_references[8 * i + 4 + k] = -rounded_down(-upper[k])
    out_references[8 * i + 3] = wp.cast(i, wp.float32)
    out_references[8 * i + 7] = wp.float32(0.0)


# Sentinel for an absent child, whose box is empty: 0, because the root is never a child.
NO_CHILD = 0

_FILES = ["core/simd.inl", "mesh/bvh/build_bvh8_cpu.inl"]
_CONSTANTS = {"BINS": BINS, "WIDTH": WIDTH, "HALVING_DEPTH": HALVING_DEPTH, "NO_CHILD": NO_CHILD, "STACK": STACK}


@wp.func_native(cpp(*_FILES, "mesh/bvh/build_top_bvh8_cpu.inl", **_CONSTANTS))
def build_top(
    references: wp.array(dtype=wp.float32),
    count: int,
    limit: int,
    capacity: int,
    scratch: wp.array(dtype=int),
    boxes: wp.array(dtype=wp.float32),
    children: wp.array(dtype=int),
    out_subtree: wp.array(dtype=int),
    out_size: wp.array(dtype=int),
): ...


@wp.func_native(cpp(*_FILES, "mesh/bvh/build_subtree_bvh8_cpu.inl", **_CONSTANTS))
def build_subtree(
    references: wp.array(dtype=wp.float32),
    subtree: int,
    begin: int,
    end: int,
    start_depth: int,
    node_base: int,
    boxes: wp.array(dtype=wp.float32),
    children: wp.array(dtype=int),
    leaf_begin: wp.array(dtype=int),
    leaf_end: wp.array(dtype=int),
    out_size: wp.array(dtype=int),
): ...


@wp.kernel
def top_kernel(
    first: int,
    references: wp.array(dtype=wp.float32),
    count: int,
    limit: int,
    capacity: int,
    scratch: wp.array(dtype=int),
    out_boxes: wp.array(dtype=wp.float32),
    out_children: wp.array(dtype=int),
    out_subtree: wp.array(dtype=int),
    out_size: wp.array(dtype=int),
):
    """Launched for one item: a single thread builds the top of the tree."""
    build_top(references, count, limit, capacity, scratch, out_boxes, out_children, out_subtree, out_size)


@wp.kernel
def subtree_kernel(
    first: int,
    references: wp.array(dtype=wp.float32),
    subtree: wp.array(dtype=int),
    node_base: wp.array(dtype=int),
    out_boxes: wp.array(dtype=wp.float32),
    out_children: wp.array(dtype=int),
    out_leaf_begin: wp.array(dtype=int),
    out_leaf_end: wp.array(dtype=int),
    out_size: wp.array(dtype=int),
):
    i = first + wp.tid()
    build_subtree(
        references,
        i,
        subtree[3 * i],
        subtree[3 * i + 1],
        subtree[3 * i + 2],
        node_base[i],
        out_boxes,
        out_children,
        out_leaf_begin,
        out_leaf_end,
        out_size,
    )


@wp.kernel
def join_kernel(
    first: int,
    references: wp.array(dtype=wp.float32),
    subtree: wp.array(dtype=int),
    node_base: wp.array(dtype=int),
    size: wp.array(dtype=int),
    node_offset: wp.array(dtype=int),
    leaf_offset: wp.array(dtype=int),
    boxes: wp.array(dtype=wp.float32),
    children: wp.array(dtype=int),
    leaf_begin: wp.array(dtype=int),
    leaf_end: wp.array(dtype=int),
    out_boxes: wp.array(dtype=wp.float32),
    out_children: wp.array(dtype=int),
    out_slot_triangle: wp.array(dtype=int),
):
    """Move the nodes and leaves of one subtree to their final places."""
    i = first + wp.tid()
    for n in range(size[2 * i]):
        source = node_base[i] + n
        target = node_offset[i] + n
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
        slot = 8 * (leaf_offset[i] + n)
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
    out_boxes: wp.array(dtype=wp.float32),
    out_children: wp.array(dtype=int),
):
    """Copy a node of the top and link its children to the roots of their subtrees."""
    node = first + wp.tid()
    for k in range(48):
        out_boxes[48 * node + k] = boxes[48 * node + k]
    for c in range(8):
        number = children[8 * node + c]
        if number < 0:
            subtree = -1 - number
            if size[2 * subtree] > 0:
                number = node_offset[subtree]
            else:
                number = -1 - leaf_offset[subtree]
        out_children[8 * node + c] = number


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


@wp.func_native(cpp("mesh/bvh/refit_bvh8.inl", WIDTH=WIDTH, NO_CHILD=NO_CHILD))
def refit_nodes(
    count: int,
    children: wp.array(dtype=int),
    block_boxes: wp.array(dtype=wp.float32),
    boxes: wp.array(dtype=wp.float32),
): ...


@wp.kernel
def refit_kernel(
    first: int,
    count: int,
    children: wp.array(dtype=int),
    block_boxes: wp.array(dtype=wp.float32),
    out_boxes: wp.array(dtype=wp.float32),
):
    """Launched for one item: there are few nodes compared with triangles."""
    refit_nodes(count, children, block_boxes, out_boxes)
