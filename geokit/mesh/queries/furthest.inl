// The corner of a triangle that is furthest from p, as three times the slot plus the corner; the tree is pruned by the
// far corners of its boxes. Ties go to the lowest triangle and its first corner.
static constexpr auto furthest_corner = [](const SurfaceTree& tree, const wp::vec3d& p) -> int {
    double best = -1.0;  // world units squared
    int winner = -1;
    auto evaluate = [&](int slot) {
        const int triangle = tree.slot_triangle.data[slot];
        if (triangle < 0) return;
        for (int k = 0; k < 3; ++k) {
            const wp::vec3d d = tree.corners.data[3 * slot + k] - p;
            const double squared = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
            if (squared < best) continue;
            if (squared == best && triangle >= tree.slot_triangle.data[winner / 3]) continue;
            best = squared;
            winner = 3 * slot + k;
        }
    };
    const wp::vec3d q = (p - tree.origin) / tree.scale;
    const double far = wp::max(wp::max(wp::abs(q[0]), wp::abs(q[1])), wp::abs(q[2]));
    // Squared distance of a box's far corner in world units, widened by the rounding error.
    auto reach_of = [&](const float* lower, const float* upper, int stride) {
        double sum = 0.0;
        for (int k = 0; k < 3; ++k) {
            const double reach =
                wp::max(q[k] - lower[k * stride], upper[k * stride] - q[k]) + (BOX_PADDING + 1e-15 * far);
            sum += reach * reach;
        }
        return sum * tree.scale * tree.scale * (1.0 + 1e-12);
    };
#if defined(__CUDA_ARCH__)
    const wp::Mesh mesh = wp::mesh_get(tree.mesh);
    int stack[64], height = 1;
    stack[0] = *mesh.bvh.root;
    while (height > 0) {
        const int node = stack[--height];
        const wp::BVHPackedNodeHalf l = wp::bvh_load_node(mesh.bvh.node_lowers, node);
        const wp::BVHPackedNodeHalf u = wp::bvh_load_node(mesh.bvh.node_uppers, node);
        if (reach_of(&l.x, &u.x, 1) < best) continue;
        if (l.b) {
            for (int slot = l.i; slot < (int)u.i; ++slot) evaluate(slot);
        } else {
            stack[height++] = l.i;
            stack[height++] = u.i;
        }
    }
#else
    int stack[STACK], height = 1;
    double entry[STACK];
    stack[0] = 0;
    entry[0] = INFINITY;
    while (height > 0) {
        --height;
        if (entry[height] < best) continue;
        const int node = stack[height];
        if (node < 0) {
            for (int j = 0; j < 8; ++j) evaluate(8 * (-1 - node) + j);
            continue;
        }
        const float* box = tree.boxes.data + 48 * node;
        const int base = height;
        for (int j = 0; j < 8; ++j) {
            if (box[j] > box[24 + j]) continue;
            const double reach = reach_of(box + j, box + 24 + j, 8);
            if (reach < best) continue;
            int at = height++;
            for (; at > base && entry[at - 1] > reach; --at) {
                entry[at] = entry[at - 1];
                stack[at] = stack[at - 1];
            }
            entry[at] = reach;
            stack[at] = tree.children.data[8 * node + j];
        }
    }
#endif
    return winner;
};
