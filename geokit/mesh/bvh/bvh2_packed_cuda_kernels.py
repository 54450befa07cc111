"""The tree of a warp Mesh as CUDA queries read it: both children's boxes in one row of 64 bytes.

Warp keeps a node's lower and upper corner in two arrays, and its children anywhere in them: a step down reads four
places, half of each of their sectors for nothing, and a node that comes back from the stack must be read before its
children can be. Here a step reads one place, and small subtrees are leaves, as large as suits the query.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.mesh.bvh.bvh8_leaves_cpu_kernels import SLOT_WORDS

wp.set_module_options({"enable_backward": False})

# Floats of a node: left lower x y z, left upper x y z, right lower x y z, right upper x y z, left and right child (as
# the bits of integers), two of nothing.
NODE_FLOATS = 16
# A child that is a leaf is -1 - (slot << LEAF_BITS | triangles - 1). Warp ends branches at a certain depth, with all
# triangles that are left in one leaf: where that is MANY or more, their number stands in the last word of the first
# one's row in the leaves.
LEAF_BITS = 3
MANY = 1 << LEAF_BITS

# load_node(nodes, node) -> Node; first_slot(child) and end_slot(child) of a leaf of `tree`.
LOAD_NODE = f"""
    struct alignas(16) Node {{
        float lx, ly, lz, lX, lY, lZ, rx, ry, rz, rX, rY, rZ;
        int left, right, none[2];
    }};
    auto load_node = [](const float* nodes, int node) {{
        Node n;
        #if defined(__CUDA_ARCH__)
        const float4* from = (const float4*)(nodes + {NODE_FLOATS} * node);
        float4* to = (float4*)&n;
        to[0] = __ldg(from); to[1] = __ldg(from + 1); to[2] = __ldg(from + 2); to[3] = __ldg(from + 3);
        #else
        n = *(const Node*)(nodes + {NODE_FLOATS} * node);
        #endif
        return n;
    }};
    auto first_slot = [](int leaf) {{ return (-1 - leaf) >> {LEAF_BITS}; }};
    auto end_slot = [&](int leaf) {{
        const int first = (-1 - leaf) >> {LEAF_BITS}, count = ((-1 - leaf) & {MANY - 1}) + 1;
        return first + (count < {MANY} ? count : ((const int*)tree.leaves.data)[{SLOT_WORDS} * (first + 1) - 1]);
    }};
"""

# Warp's builders on a GPU leave the number of nodes at zero: they make one less than twice the triangles.
_COUNT = "const int nodes = bvh.num_nodes > 0 ? bvh.num_nodes : 2 * bvh.num_items - 1;"


@wp.func_native("const wp::BVH& bvh = wp::mesh_get(id).bvh;" + _COUNT + "return nodes;")
def node_count(id: wp.uint64) -> int: ...


# The triangles under a node stand in slots in a row: from the leftmost leaf's first to the rightmost one's last.
_RANGE = """
    auto is_leaf = [&](int at) { return (bool)wp::bvh_load_node(bvh.node_lowers, at).b; };
    auto begin_of = [&](int at) {
        while (!is_leaf(at)) at = wp::bvh_load_node(bvh.node_lowers, at).i;
        return (int)wp::bvh_load_node(bvh.node_lowers, at).i;
    };
    auto end_of = [&](int at) {
        while (!is_leaf(at)) at = wp::bvh_load_node(bvh.node_uppers, at).i;
        return (int)wp::bvh_load_node(bvh.node_uppers, at).i;
    };
"""


@wp.func_native(
    "const wp::BVH& bvh = wp::mesh_get(id).bvh;"
    + _RANGE
    + "return !is_leaf(node) && end_of(node) - begin_of(node) > most;"
)
def is_kept(id: wp.uint64, node: int, most: int) -> bool:
    """Whether a node has more triangles than a leaf may."""
    ...


@wp.func_native(
    "const wp::BVH& bvh = wp::mesh_get(id).bvh;"
    + _RANGE
    + f"""
    auto reference = [&](int child) {{
        const int begin = begin_of(child), count = end_of(child) - begin;
        if (count > most && !is_leaf(child)) return place.data[child] - 1;
        if (count >= {MANY}) ((int*)out_leaves.data)[{SLOT_WORDS} * (begin + 1) - 1] = count;
        return -1 - (begin << {LEAF_BITS} | (wp::min(count, {MANY}) - 1));
    }};
    if (node == *bvh.root) out_root.data[0] = reference(node);
    if (!kept.data[node]) return;
    const int child[2] = {{(int)wp::bvh_load_node(bvh.node_lowers, node).i,
                          (int)wp::bvh_load_node(bvh.node_uppers, node).i}};
    float* row = out_nodes.data + {NODE_FLOATS} * (place.data[node] - 1);
    for (int k = 0; k < 2; ++k) {{
        const wp::BVHPackedNodeHalf l = wp::bvh_load_node(bvh.node_lowers, child[k]);
        const wp::BVHPackedNodeHalf u = wp::bvh_load_node(bvh.node_uppers, child[k]);
        row[6 * k] = l.x - padding; row[6 * k + 1] = l.y - padding; row[6 * k + 2] = l.z - padding;
        row[6 * k + 3] = u.x + padding; row[6 * k + 4] = u.y + padding; row[6 * k + 5] = u.z + padding;
        ((int*)row)[12 + k] = reference(child[k]);
    }}
"""
)
def pack_node(
    id: wp.uint64,
    node: int,
    most: int,
    padding: wp.float32,
    kept: wp.array(dtype=int),
    place: wp.array(dtype=int),
    out_leaves: wp.array(dtype=wp.float32),
    out_nodes: wp.array(dtype=wp.float32),
    out_root: wp.array(dtype=int),
): ...


@wp.kernel
def node_count_kernel(first: int, mesh: wp.uint64, out_count: wp.array(dtype=int)):
    out_count[first + wp.tid()] = node_count(mesh)


@wp.kernel
def mark_kept_kernel(first: int, mesh: wp.uint64, most: int, out_kept: wp.array(dtype=int)):
    """1 for nodes that get a row, 0 for those that are leaves or within one."""
    node = first + wp.tid()
    out_kept[node] = wp.where(is_kept(mesh, node, most), 1, 0)


@wp.kernel
def pack_nodes_kernel(
    first: int,
    mesh: wp.uint64,
    most: int,
    padding: wp.float32,
    kept: wp.array(dtype=int),
    place: wp.array(dtype=int),
    out_leaves: wp.array(dtype=wp.float32),
    out_nodes: wp.array(dtype=wp.float32),
    out_root: wp.array(dtype=int),
):
    """Rows of the nodes that are kept at their places (counted from one), and the reference of the root."""
    pack_node(mesh, first + wp.tid(), most, padding, kept, place, out_leaves, out_nodes, out_root)
