// Writes a node of warp's tree, if it is kept, as a row of NODE_FLOATS floats, and the reference of the root.
//
// Expects node_range_bvh2_cuda.inl; node, most, padding, kept, place, out_leaves, out_nodes, out_root; NODE_FLOATS,
// LEAF_BITS, MANY, SLOT_WORDS.
auto reference = [&](int child) {
    const int begin = begin_of(child), count = end_of(child) - begin;
    if (count > most && !is_leaf(child)) return place.data[child] - 1;
    if (count >= MANY) ((int*)out_leaves.data)[SLOT_WORDS * (begin + 1) - 1] = count;
    return -1 - (begin << LEAF_BITS | (wp::min(count, MANY) - 1));
};
if (node == *bvh.root) out_root.data[0] = reference(node);
if (!kept.data[node]) return;
const int child[2] = {(int)wp::bvh_load_node(bvh.node_lowers, node).i, (int)wp::bvh_load_node(bvh.node_uppers, node).i};
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
