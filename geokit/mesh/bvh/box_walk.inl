// Boxes in a tree's local frame, and the traversals that visit the triangles of a surface whose boxes overlap one, or
// are near one.
#pragma once
#include "core/simd.inl"
#include "mesh/bvh/bvh2.inl"

// Slots that a walk visits at once.
#if defined(__CUDA_ARCH__)
static constexpr int AT_ONCE = 1;
#else
static constexpr int AT_ONCE = 8;
#endif

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

// The squared distance of boxes from the one from low to high, three doubles each: of one box on CUDA, of eight, given as
// six rows, on a CPU.
#if defined(__CUDA_ARCH__)
static constexpr auto squared_gap = [](const double* low, const double* high, double lx, double ly, double lz,
                                       double ux, double uy, double uz) {
    const double x = wp::max(wp::max(lx - high[0], low[0] - ux), 0.0),
                 y = wp::max(wp::max(ly - high[1], low[1] - uy), 0.0),
                 z = wp::max(wp::max(lz - high[2], low[2] - uz), 0.0);
    return x * x + y * y + z * z;
};
#else
static constexpr auto squared_gap = [](const double* low, const double* high, const float* rows) {
    const d8 zero = 0.0;
    d8 sum = 0.0;
    for (int k = 0; k < 3; ++k) {
        const d8 from = __builtin_convertvector(*(const v8*)(rows + 8 * k), d8),
                 to = __builtin_convertvector(*(const v8*)(rows + 24 + 8 * k), d8);
        const d8 gap = __builtin_elementwise_max(__builtin_elementwise_max(from - high[k], low[k] - to), zero);
        sum += gap * gap;
    }
    return sum;
};
#endif

// As walk_boxes, the nearest first, for boxes within the squared distance `reach` of the local one from low to high,
// three doubles each. `visit` may lower the reach.
static constexpr auto walk_nearest = [](const SurfaceTree& tree, const double* low, const double* high,
                                        const double& reach, auto&& visit) {
#if defined(__CUDA_ARCH__)
    int stack[64], height = 0, node = tree.children.data[0];  // deeper than a tree of bvh2.py may be
    double entry[64];
    while (true) {
        if (node >= 0) {
            const Node n = load_node(tree.boxes.data, node);
            const double dl = squared_gap(low, high, n.lx, n.ly, n.lz, n.lX, n.lY, n.lZ),
                         dr = squared_gap(low, high, n.rx, n.ry, n.rz, n.rX, n.rY, n.rZ);
            const bool left_first = dl <= dr;
            if ((left_first ? dr : dl) <= reach) {
                stack[height] = left_first ? n.right : n.left;
                entry[height++] = left_first ? dr : dl;
            }
            node = left_first ? n.left : n.right;
            if ((left_first ? dl : dr) <= reach) continue;
        } else
            for (int first = first_slot(node); first < end_slot(node); ++first) visit(first);
        do --height;
        while (height >= 0 && entry[height] > reach);
        if (height < 0) break;
        node = stack[height];
    }
#else
    int stack[STACK], height = 1;
    double entry[STACK];
    stack[0] = 0;
    entry[0] = 0.0;
    while (height > 0) {
        --height;
        if (entry[height] > reach) continue;
        const int node = stack[height], base = height;
        if (node < 0) {
            visit(8 * (-1 - node));
            continue;
        }
        const float* rows = tree.boxes.data + 48 * node;
        const d8 gap = squared_gap(low, high, rows);
        for (unsigned mask = mask_of(gap <= reach); mask; mask &= mask - 1) {
            const int j = __builtin_ctz(mask);
            if (rows[j] > rows[24 + j]) continue;  // no child
            const double d = gap[j];
            int at = height++;
            for (; at > base && entry[at - 1] < d; --at) {
                entry[at] = entry[at - 1];
                stack[at] = stack[at - 1];
            }
            entry[at] = d;
            stack[at] = tree.children.data[8 * node + j];
        }
    }
#endif
};
