// Boxes in a tree's local frame, and the traversal that visits the triangles of a surface whose boxes overlap one.
#include "core/simd.inl"
#include "mesh/bvh/bvh2.inl"

static constexpr auto rounded_down = [](double x) { return (float)x - wp::abs((float)x) * 1.2e-7f - 1e-30f; };
// A world box in a tree's local frame, rounded outward to float32. Rounding is monotone: boxes that touch in the world
// touch here.
static constexpr auto local_box = [](const SurfaceTree& tree, const double* lower, const double* upper, float* low,
                                     float* high) {
    for (int k = 0; k < 3; ++k) {
        const double from = (lower[k] - tree.origin[k]) / tree.scale, to = (upper[k] - tree.origin[k]) / tree.scale;
        low[k] = rounded_down(wp::clamp(from, -FARTHEST, FARTHEST));
        high[k] = -rounded_down(-wp::clamp(to, -FARTHEST, FARTHEST));
    }
};

// Writes the local box of a slot's triangle to its column in a block of eight slots; an empty slot's box is inverted.
static constexpr auto slot_box = [](const SurfaceTree& tree, int slot, wp::array_t<float>& out_boxes) {
    float* row = out_boxes.data + 48 * (slot / 8) + slot % 8;
    if (tree.slot_triangle.data[slot] < 0) {
        for (int k = 0; k < 3; ++k) {
            row[8 * k] = INFINITY;
            row[24 + 8 * k] = -INFINITY;
        }
        return;
    }
    double lower[3], upper[3];
    const wp::vec3d* p = tree.corners.data + 3 * slot;
    for (int k = 0; k < 3; ++k) {
        lower[k] = wp::min(wp::min(p[0][k], p[1][k]), p[2][k]);
        upper[k] = wp::max(wp::max(p[0][k], p[1][k]), p[2][k]);
    }
    float low[3], high[3];
    local_box(tree, lower, upper, low, high);
    for (int k = 0; k < 3; ++k) {
        row[8 * k] = low[k];
        row[24 + 8 * k] = high[k];
    }
};

// Calls visit(first) with the first slot of each leaf of eight slots on a CPU, and with each slot of a leaf on CUDA,
// whose box overlaps the local one from low to high, three floats each.
static constexpr auto walk_boxes = [](const SurfaceTree& tree, const float* low, const float* high, auto&& visit) {
    int stack[STACK], height = 1;
#if defined(__CUDA_ARCH__)
    auto reaches = [&](float lx, float ly, float lz, float ux, float uy, float uz) {
        return lx <= high[0] && ly <= high[1] && lz <= high[2] && ux >= low[0] && uy >= low[1] && uz >= low[2];
    };
    stack[0] = tree.children.data[0];
    while (height > 0) {
        const int node = stack[--height];
        if (node < 0) {
            for (int first = first_slot(node); first < end_slot(node); ++first) visit(first);
            continue;
        }
        const Node n = load_node(tree.boxes.data, node);
        if (reaches(n.rx, n.ry, n.rz, n.rX, n.rY, n.rZ)) stack[height++] = n.right;
        if (reaches(n.lx, n.ly, n.lz, n.lX, n.lY, n.lZ)) stack[height++] = n.left;
    }
#else
    stack[0] = 0;
    while (height > 0) {
        const int node = stack[--height];
        if (node < 0) {
            visit(8 * (-1 - node));
            continue;
        }
        const v8* side = (const v8*)(tree.boxes.data + 48 * node);
        const auto meets = (side[0] <= high[0]) & (side[1] <= high[1]) & (side[2] <= high[2]) & (side[3] >= low[0])
                           & (side[4] >= low[1]) & (side[5] >= low[2]);
        const int* child = tree.children.data + 8 * node;
        for (unsigned mask = mask_of(meets); mask; mask &= mask - 1) stack[height++] = child[__builtin_ctz(mask)];
    }
#endif
};
