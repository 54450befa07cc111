"""C++ text of the nearest-triangle search over the tree of a warp Mesh, on CUDA, with boxes widened by their rounding."""

from geokit.mesh._tree_kernels import BOX_PADDING

# Names as in WIDE_NEAREST; the seed is of no use here. Distances in world units. The stack holds what warp's own
# queries need: its builders bound the depth of the tree by 32.
BINARY_NEAREST = f"""
    const wp::Mesh mesh = wp::mesh_get(tree.mesh);
    const double qx = (p[0] - tree.origin[0]) / tree.scale, qy = (p[1] - tree.origin[1]) / tree.scale, qz = (p[2] - tree.origin[2]) / tree.scale;
    const double far = (qx < 0 ? -qx : qx) + (qy < 0 ? -qy : qy) + (qz < 0 ? -qz : qz);
    const double padding = {BOX_PADDING} + 1e-15 * far;
    const wp::BVHPackedNodeHalf* lowers = mesh.bvh.node_lowers;
    const wp::BVHPackedNodeHalf* uppers = mesh.bvh.node_uppers;
    auto box_squared = [&](const wp::BVHPackedNodeHalf& l, const wp::BVHPackedNodeHalf& u) {{
        double x = l.x - qx, y = l.y - qy, z = l.z - qz;
        const double x1 = qx - u.x, y1 = qy - u.y, z1 = qz - u.z;
        x = x > x1 ? x : x1; y = y > y1 ? y : y1; z = z > z1 ? z : z1;
        x = x > 0.0 ? x : 0.0; y = y > 0.0 ? y : 0.0; z = z > 0.0 ? z : 0.0;
        return x * x + y * y + z * z;
    }};
    double best = max_squared;         // world units squared
    int winner = -1;
    auto reach_of = [&](double squared) {{
        const double reach = sqrt(squared) / tree.scale + padding;
        return reach * reach;
    }};
    double reach = reach_of(best);     // local units squared, widened
    int stack[64];
    double entry[64];
    int depth = 0;
    stack[0] = *mesh.bvh.root;
    entry[0] = 0.0;
    depth = 1;
    while (depth > 0) {{
        --depth;
        if (entry[depth] > reach) continue;
        int node = stack[depth];
        wp::BVHPackedNodeHalf l = wp::bvh_load_node(lowers, node), u = wp::bvh_load_node(uppers, node);
        while (!l.b) {{
            const int left = l.i, right = u.i;
            const wp::BVHPackedNodeHalf ll = wp::bvh_load_node(lowers, left), lu = wp::bvh_load_node(uppers, left);
            const wp::BVHPackedNodeHalf rl = wp::bvh_load_node(lowers, right), ru = wp::bvh_load_node(uppers, right);
            const double dl = box_squared(ll, lu), dr = box_squared(rl, ru);
            const bool left_first = dl <= dr;
            const double near = left_first ? dl : dr, later = left_first ? dr : dl;
            if (later <= reach) {{
                stack[depth] = left_first ? right : left;
                entry[depth++] = later;
            }}
            if (near > reach) break;
            l = left_first ? ll : rl;
            u = left_first ? lu : ru;
        }}
        if (!l.b) continue;
        for (int slot = l.i; slot < (int)u.i; ++slot) {{
            const point a = tree.corners.data[3 * slot], b = tree.corners.data[3 * slot + 1], c = tree.corners.data[3 * slot + 2];
            double v, w;
            const double squared = closest_on_triangle(p - a, b - a, c - a, v, w);
            if (squared > best) continue;
            // Ties go to the lowest triangle: the answer must not depend on the order of the walk.
            if (squared == best && winner >= 0 && tree.slot_triangle.data[slot] > tree.slot_triangle.data[winner]) continue;
            if (squared < best) reach = reach_of(squared);
            best = squared;
            winner = slot;
        }}
    }}
    return winner;
"""
