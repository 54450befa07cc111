"""The inner nodes of a warp Mesh's tree as CUDA queries read them: both children's boxes in one row of 64 bytes.

Warp keeps a node's lower and upper corner in two arrays, and its children anywhere in them: a step down reads four
places, half of each of their sectors for nothing, and a node that comes back from the stack must be read before its
children can be. Here a step reads one place.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False})

# Floats of a node: left lower x y z, left upper x y z, right lower x y z, right upper x y z, left and right child (as
# the bits of integers), two of nothing.
NODE_FLOATS = 16
# A child that is a leaf is -1 - (slot << LEAF_BITS | triangles - 1).
LEAF_BITS = 3

# load_node(tree, node) -> Node; for_each_slot's pieces: first_slot(child), last_slot(child) of a leaf's reference.
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
    auto end_slot = [](int leaf) {{
        return ((-1 - leaf) >> {LEAF_BITS}) + ((-1 - leaf) & {(1 << LEAF_BITS) - 1}) + 1;
    }};
"""


# Warp's builders on a GPU leave the number of nodes at zero: they make one less than twice the triangles.
_COUNT = "const int nodes = bvh.num_nodes > 0 ? bvh.num_nodes : 2 * bvh.num_items - 1;"


@wp.func_native("const wp::BVH& bvh = wp::mesh_get(id).bvh;" + _COUNT + "return nodes;")
def node_count(id: wp.uint64) -> int: ...


@wp.func_native(
    """
    const wp::BVH& bvh = wp::mesh_get(id).bvh;
    return !wp::bvh_load_node(bvh.node_lowers, node).b;
"""
)
def is_inner(id: wp.uint64, node: int) -> bool: ...


@wp.func_native(
    f"""
    const wp::BVH& bvh = wp::mesh_get(id).bvh;
    {_COUNT}
    auto reference = [&](int child) {{
        const wp::BVHPackedNodeHalf l = wp::bvh_load_node(bvh.node_lowers, child);
        const int slots = (int)wp::bvh_load_node(bvh.node_uppers, child).i - (int)l.i;
        return l.b ? -1 - ((int)l.i << {LEAF_BITS} | (slots - 1)) : place.data[child] - 1;
    }};
    if (node == *bvh.root) out_root.data[0] = reference(node);
    const wp::BVHPackedNodeHalf lower = wp::bvh_load_node(bvh.node_lowers, node);
    const wp::BVHPackedNodeHalf upper = wp::bvh_load_node(bvh.node_uppers, node);
    if (lower.b) return;
    const int child[2] = {{(int)lower.i, (int)upper.i}};
    float* row = out_nodes.data + {NODE_FLOATS} * (place.data[node] - 1);
    for (int k = 0; k < 2; ++k) {{
        // A node that the tree does not use may point anywhere.
        if (child[k] < 0 || child[k] >= nodes) return;
        const wp::BVHPackedNodeHalf l = wp::bvh_load_node(bvh.node_lowers, child[k]);
        const wp::BVHPackedNodeHalf u = wp::bvh_load_node(bvh.node_uppers, child[k]);
        row[6 * k] = l.x; row[6 * k + 1] = l.y; row[6 * k + 2] = l.z;
        row[6 * k + 3] = u.x; row[6 * k + 4] = u.y; row[6 * k + 5] = u.z;
        ((int*)row)[12 + k] = reference(child[k]);
    }}
"""
)
def pack_node(
    id: wp.uint64,
    node: int,
    place: wp.array(dtype=int),
    out_nodes: wp.array(dtype=wp.float32),
    out_root: wp.array(dtype=int),
): ...


@wp.kernel
def node_count_kernel(first: int, mesh: wp.uint64, out_count: wp.array(dtype=int)):
    out_count[first + wp.tid()] = node_count(mesh)


@wp.kernel
def mark_inner_kernel(first: int, mesh: wp.uint64, out_inner: wp.array(dtype=int)):
    """1 for nodes that have children, 0 for leaves."""
    node = first + wp.tid()
    out_inner[node] = wp.where(is_inner(mesh, node), 1, 0)


@wp.kernel
def pack_nodes_kernel(
    first: int,
    mesh: wp.uint64,
    place: wp.array(dtype=int),
    out_nodes: wp.array(dtype=wp.float32),
    out_root: wp.array(dtype=int),
):
    """Rows of the inner nodes at their places (counted from one), and the reference of the root."""
    pack_node(mesh, first + wp.tid(), place, out_nodes, out_root)
