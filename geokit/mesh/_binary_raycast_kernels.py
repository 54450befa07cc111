"""C++ text of ray queries over the tree of a warp Mesh, on CUDA: float32 boxes widened by their rounding.

Warp's own ray query tests unpadded boxes and leaks thousands of rays per million that aim at edges and vertices.
"""

from geokit.mesh._tree_kernels import BOX_PADDING

# Names as in WIDE_WALK. A thread has one ray: begin + 1 is end.
BINARY_WALK = f"""
    struct Ray {{
        point start, direction;
        double best, weight_b, weight_c;
        int id, winner, height, count;
    }};
    auto shorten = [](Ray&) {{}};
    const wp::Mesh mesh = wp::mesh_get(tree.mesh);
    Ray r;
    r.winner = -1; r.count = 0; r.weight_b = 0.0; r.weight_c = 0.0;
    fetch(begin, r.id, r.start, r.direction, r.best);
    double inverse[3], from[3], far = 0.0, largest = 0.0;
    for (int k = 0; k < 3; ++k) largest = wp::max(largest, wp::abs(r.direction[k]));
    for (int k = 0; k < 3; ++k) {{
        from[k] = (r.start[k] - tree.origin[k]) / tree.scale;
        far += wp::abs(from[k]);
        // A component that is zero, or too small to matter, must not make 0 * inf in the slab test.
        const double least = 1e-200 * largest, d = r.direction[k];
        inverse[k] = tree.scale / (wp::abs(d) > least ? d : (d < 0.0 ? -least : least));
    }}
    const double padding = {BOX_PADDING} + 1e-15 * far;
    // Where the ray enters the widened box, or infinity.
    auto entry_of = [&](const wp::BVHPackedNodeHalf& l, const wp::BVHPackedNodeHalf& u) {{
        const double x0 = (l.x - padding - from[0]) * inverse[0], x1 = (u.x + padding - from[0]) * inverse[0];
        const double y0 = (l.y - padding - from[1]) * inverse[1], y1 = (u.y + padding - from[1]) * inverse[1];
        const double z0 = (l.z - padding - from[2]) * inverse[2], z1 = (u.z + padding - from[2]) * inverse[2];
        double in = t_min, out = r.best;
        in = wp::max(in, wp::min(x0, x1)); out = wp::min(out, wp::max(x0, x1));
        in = wp::max(in, wp::min(y0, y1)); out = wp::min(out, wp::max(y0, y1));
        in = wp::max(in, wp::min(z0, z1)); out = wp::min(out, wp::max(z0, z1));
        return in <= out ? in : (double)INFINITY;
    }};
    int stack[64];
    double entry[64];
    r.height = 1;
    stack[0] = *mesh.bvh.root;
    entry[0] = 0.0;
    while (r.height > 0) {{
        --r.height;
        if (entry[r.height] > r.best) continue;
        wp::BVHPackedNodeHalf l = wp::bvh_load_node(mesh.bvh.node_lowers, stack[r.height]);
        wp::BVHPackedNodeHalf u = wp::bvh_load_node(mesh.bvh.node_uppers, stack[r.height]);
        bool reached = true;
        while (!l.b && reached) {{
            const int left = l.i, right = u.i;
            const wp::BVHPackedNodeHalf ll = wp::bvh_load_node(mesh.bvh.node_lowers, left);
            const wp::BVHPackedNodeHalf lu = wp::bvh_load_node(mesh.bvh.node_uppers, left);
            const wp::BVHPackedNodeHalf rl = wp::bvh_load_node(mesh.bvh.node_lowers, right);
            const wp::BVHPackedNodeHalf ru = wp::bvh_load_node(mesh.bvh.node_uppers, right);
            const double tl = entry_of(ll, lu), tr = entry_of(rl, ru);
            const bool left_first = tl <= tr;
            const double later = left_first ? tr : tl;
            reached = (left_first ? tl : tr) < INFINITY;
            if (later < INFINITY) {{
                stack[r.height] = left_first ? right : left;
                entry[r.height++] = later;
            }}
            l = left_first ? ll : rl;
            u = left_first ? lu : ru;
        }}
        if (!reached) continue;
        for (int slot = l.i; slot < (int)u.i && r.height >= 0; ++slot) {{
            double t, v, w;
            if (!hit(r.start, r.direction, slot, t, v, w) || t > r.best) continue;
            ON_HIT
        }}
    }}
    ON_END
"""
