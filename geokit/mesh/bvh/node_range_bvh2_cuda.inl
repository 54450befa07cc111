// The triangles under a node of warp's tree are in consecutive slots: from the first slot of the leftmost leaf to the
// last slot of the rightmost one.
//
// Expects id (of a warp Mesh). Defines bvh, is_leaf, begin_of and end_of.
const wp::BVH& bvh = wp::mesh_get(id).bvh;
auto is_leaf = [&](int at) { return (bool)wp::bvh_load_node(bvh.node_lowers, at).b; };
auto begin_of = [&](int at) {
    while (!is_leaf(at)) at = wp::bvh_load_node(bvh.node_lowers, at).i;
    return (int)wp::bvh_load_node(bvh.node_lowers, at).i;
};
auto end_of = [&](int at) {
    while (!is_leaf(at)) at = wp::bvh_load_node(bvh.node_uppers, at).i;
    return (int)wp::bvh_load_node(bvh.node_uppers, at).i;
};
