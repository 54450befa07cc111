// The packed tree of bvh2_packed_cuda_kernels: how it is written, and how searches on CUDA read it.
//
// CPU branches are for tests, which run a CUDA search there.
#pragma once

struct alignas(16) Node {
    float lx, ly, lz, lX, lY, lZ, rx, ry, rz, rX, rY, rZ;
    int left, right, none[2];
};
static constexpr auto load_node = [](const float* nodes, int node) {
    Node n;
    #if defined(__CUDA_ARCH__)
    const float4* from = (const float4*)(nodes + NODE_FLOATS * node);
    float4* to = (float4*)&n;
    to[0] = __ldg(from);
    to[1] = __ldg(from + 1);
    to[2] = __ldg(from + 2);
    to[3] = __ldg(from + 3);
    #else
    n = *(const Node*)(nodes + NODE_FLOATS * node);
    #endif
    return n;
};
static constexpr auto first_slot = [](int leaf) { return (-1 - leaf) >> LEAF_BITS; };
static constexpr auto end_slot = [](const wp::array_t<float>& leaves, int leaf) -> int {
    const int first = (-1 - leaf) >> LEAF_BITS, count = ((-1 - leaf) & MANY - 1) + 1;
    return first + (count < MANY ? count : ((const int*)leaves.data)[SLOT_WORDS * (first + 1) - 1]);
};

// The triangles under a node of warp's tree are in consecutive slots: from the first slot of the leftmost leaf to the
// last slot of the rightmost one.
static constexpr auto is_leaf = [](const wp::BVH& bvh, int at) {
    return (bool)wp::bvh_load_node(bvh.node_lowers, at).b;
};
static constexpr auto begin_of = [](const wp::BVH& bvh, int at) {
    while (!is_leaf(bvh, at)) at = wp::bvh_load_node(bvh.node_lowers, at).i;
    return (int)wp::bvh_load_node(bvh.node_lowers, at).i;
};
static constexpr auto end_of = [](const wp::BVH& bvh, int at) {
    while (!is_leaf(bvh, at)) at = wp::bvh_load_node(bvh.node_uppers, at).i;
    return (int)wp::bvh_load_node(bvh.node_uppers, at).i;
};

// Whether a node keeps its own row because it has too many triangles for a leaf.
static constexpr auto is_kept = [](wp::uint64 id, int node, int most) -> bool {
    const wp::BVH& bvh = wp::mesh_get(id).bvh;
    return !is_leaf(bvh, node) && end_of(bvh, node) - begin_of(bvh, node) > most;
};

// Writes a node of warp's tree, if it is kept, as a row of NODE_FLOATS floats, and the reference of the root.
static constexpr auto pack_node = [](int node, wp::uint64 id, int most, float padding, const wp::array_t<int>& kept,
                                     const wp::array_t<int>& place, wp::array_t<float>& out_leaves,
                                     wp::array_t<float>& out_nodes, wp::array_t<int>& out_root) {
    const wp::BVH& bvh = wp::mesh_get(id).bvh;
    auto reference = [&](int child) {
        const int begin = begin_of(bvh, child), count = end_of(bvh, child) - begin;
        if (count > most && !is_leaf(bvh, child)) return place.data[child] - 1;
        if (count >= MANY) ((int*)out_leaves.data)[SLOT_WORDS * (begin + 1) - 1] = count;
        return -1 - (begin << LEAF_BITS | (wp::min(count, MANY) - 1));
    };
    if (node == *bvh.root) out_root.data[0] = reference(node);
    if (!kept.data[node]) return;
    const int child[2] = {(int)wp::bvh_load_node(bvh.node_lowers, node).i,
                          (int)wp::bvh_load_node(bvh.node_uppers, node).i};
    float* row = out_nodes.data + NODE_FLOATS * (place.data[node] - 1);
    for (int k = 0; k < 2; ++k) {
        const wp::BVHPackedNodeHalf l = wp::bvh_load_node(bvh.node_lowers, child[k]);
        const wp::BVHPackedNodeHalf u = wp::bvh_load_node(bvh.node_uppers, child[k]);
        row[6 * k] = l.x - padding;
        row[6 * k + 1] = l.y - padding;
        row[6 * k + 2] = l.z - padding;
        row[6 * k + 3] = u.x + padding;
        row[6 * k + 4] = u.y + padding;
        row[6 * k + 5] = u.z + padding;
        ((int*)row)[12 + k] = reference(child[k]);
    }
};
