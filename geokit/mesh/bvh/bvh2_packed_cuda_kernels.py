"""The tree of a warp Mesh as CUDA queries read it: both children's boxes in one row of 64 bytes.

Warp keeps the lower and upper corners of nodes in two arrays, with children at arbitrary indices. So a step down reads
four places and wastes half of each sector, and a node from the stack must be read before its children can be. In the
packed tree a step reads one place, and small subtrees are leaves whose size suits the query.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.leaf_planes_kernels import SLOT_WORDS

wp.set_module_options({"enable_backward": False})

# Floats of a node: left lower x y z, left upper x y z, right lower x y z, right upper x y z, left and right child (as
# the bits of integers), two unused.
NODE_FLOATS = 16
# A child that is a leaf is -1 - (slot << LEAF_BITS | triangles - 1). Warp ends branches at a certain depth and puts all
# remaining triangles into one leaf. If there are MANY or more, their number is in the last word of the first triangle's
# row in the leaves.
LEAF_BITS = 3
MANY = 1 << LEAF_BITS

NODE_CONSTANTS = {"NODE_FLOATS": NODE_FLOATS, "LEAF_BITS": LEAF_BITS, "MANY": MANY, "SLOT_WORDS": SLOT_WORDS}


# Warp's GPU builders leave the number of nodes at zero: it is twice the number of triangles minus one.
@wp.func_native(
    """
    const wp::BVH& bvh = wp::mesh_get(id).bvh;
    return bvh.num_nodes > 0 ? bvh.num_nodes : 2 * bvh.num_items - 1;
    """
)
def node_count(id: wp.uint64) -> int: ...


@cpp.func_native("mesh/bvh/bvh2_packed.inl", **NODE_CONSTANTS)
def is_kept(id: wp.uint64, node: int, most: int) -> bool:
    """Whether a node keeps its own row because it has too many triangles for a leaf."""
    ...


@wp.kernel
def node_count_kernel(first: int, mesh: wp.uint64, out_count: wp.array(dtype=int)):
    out_count[first + wp.tid()] = node_count(mesh)


@wp.kernel
def mark_kept_kernel(first: int, mesh: wp.uint64, most: int, out_kept: wp.array(dtype=int)):
    """1 for nodes that get a row, 0 for leaves and nodes inside a leaf."""
    node = first + wp.tid()
    out_kept[node] = wp.where(is_kept(mesh, node, most), 1, 0)


@wp.kernel
@cpp.native_item("mesh/bvh/bvh2_packed.inl", "pack_node", **NODE_CONSTANTS)
def pack_nodes_kernel(first: int):
    """Write the rows of the kept nodes to their places (counted from one), and the reference of the root."""
