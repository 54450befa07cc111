#include "mesh/bvh/bvh2.inl"

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
    int stack[STACK], height = 1;
    double entry[STACK];
    // Puts a node on the stack, sorted among those from base on: the one with the furthest corner comes next.
    auto push = [&](int base, int node, const float* lower, const float* upper, int stride) {
        const double reach = reach_of(lower, upper, stride);
        if (reach < best) return;
        int at = height++;
        for (; at > base && entry[at - 1] > reach; --at) {
            entry[at] = entry[at - 1];
            stack[at] = stack[at - 1];
        }
        entry[at] = reach;
        stack[at] = node;
    };
    entry[0] = INFINITY;
#if defined(__CUDA_ARCH__)
    stack[0] = tree.children.data[0];
#else
    stack[0] = 0;
#endif
    while (height > 0) {
        --height;
        if (entry[height] < best) continue;
        const int node = stack[height], base = height;
#if defined(__CUDA_ARCH__)
        if (node < 0) {
            for (int slot = first_slot(node); slot < end_slot(node); ++slot) evaluate(slot);
            continue;
        }
        const Node n = load_node(tree.boxes.data, node);
        push(base, n.left, &n.lx, &n.lX, 1);
        push(base, n.right, &n.rx, &n.rX, 1);
#else
        if (node < 0) {
            for (int j = 0; j < 8; ++j) evaluate(8 * (-1 - node) + j);
            continue;
        }
        const float* box = tree.boxes.data + 48 * node;
        for (int j = 0; j < 8; ++j)
            if (box[j] <= box[24 + j]) push(base, tree.children.data[8 * node + j], box + j, box + 24 + j, 8);
#endif
    }
    return winner;
};
