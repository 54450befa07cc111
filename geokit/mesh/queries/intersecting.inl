// Pairs of intersecting triangles for one item: a leaf of eight slots on a CPU, one slot on CUDA.
#include "mesh/bvh/box_walk.inl"
#include "mesh/triangle/pair.inl"

// Calls test(slot, other) with a slot of `surface` and one of `tree` whose boxes are no farther apart than `margin`
// [world]. Pairs of a surface with itself are visited once, from the lower slot.
static constexpr auto visit_near = [](int item, const SurfaceTree& surface, const SurfaceTree& tree,
                                      const wp::array_t<float>& slot_boxes, bool itself, double margin, auto&& test) {
#if defined(__CUDA_ARCH__)
    const int width = 1;
#else
    const int width = 8;
#endif
    float lows[width][3], highs[width][3], low[3], high[3];
    for (int k = 0; k < 3; ++k) {
        low[k] = INFINITY;
        high[k] = -INFINITY;
    }
    for (int lane = 0; lane < width; ++lane) {
        const int slot = width * item + lane;
        if (surface.slot_triangle.data[slot] < 0) {
            for (int k = 0; k < 3; ++k) {
                lows[lane][k] = INFINITY;
                highs[lane][k] = -INFINITY;
            }
            continue;
        }
        double lower[3], upper[3];
        const point* p = surface.corners.data + 3 * slot;
        for (int k = 0; k < 3; ++k) {
            lower[k] = wp::min(wp::min(p[0][k], p[1][k]), p[2][k]) - margin;
            upper[k] = wp::max(wp::max(p[0][k], p[1][k]), p[2][k]) + margin;
        }
        local_box(tree, lower, upper, lows[lane], highs[lane]);
        for (int k = 0; k < 3; ++k) {
            low[k] = wp::min(low[k], lows[lane][k]);
            high[k] = wp::max(high[k], highs[lane][k]);
        }
    }
    auto visit = [&](int first) {
        if (itself && first < width * item) return;
    #if defined(__CUDA_ARCH__)
        if (!itself || first > item) test(item, first);
    #else
        const v8* box = (const v8*)(slot_boxes.data + 6 * first);
        for (int lane = 0; lane < 8; ++lane) {
            const auto meets = (box[0] <= highs[lane][0]) & (box[1] <= highs[lane][1]) & (box[2] <= highs[lane][2])
                               & (box[3] >= lows[lane][0]) & (box[4] >= lows[lane][1]) & (box[5] >= lows[lane][2]);
            unsigned mask = mask_of(meets);
            if (itself && first == 8 * item) mask &= ~0u << (lane + 1);
            for (; mask; mask &= mask - 1) test(8 * item + lane, first + __builtin_ctz(mask));
        }
    #endif
    };
    walk_boxes(tree, low, high, visit);
};

// Calls on_pair(slot, other) with those that intersect.
static constexpr auto visit_pairs = [](int item, const SurfaceTree& surface, const SurfaceTree& tree,
                                       const wp::array_t<float>& slot_boxes, bool itself, double unit, auto&& on_pair) {
    visit_near(item, surface, tree, slot_boxes, itself, 0.0, [&](int slot, int other) {
        point t[3], u[3];
        for (int k = 0; k < 3; ++k) {
            t[k] = surface.corners.data[3 * slot + k] * unit;
            u[k] = tree.corners.data[3 * other + k] * unit;
        }
        if (itself ? meet_beyond_shared(t, u) : triangles_meet(t, u)) on_pair(slot, other);
    });
};

static constexpr auto count_pairs = [](int item, const SurfaceTree& surface, const SurfaceTree& tree,
                                       const wp::array_t<float>& slot_boxes, bool itself, double unit,
                                       wp::array_t<wp::int64>& out_count) {
    wp::int64 count = 0;
    visit_pairs(item, surface, tree, slot_boxes, itself, unit, [&](int, int) { ++count; });
    out_count.data[item] = count;
};

// Writes pairs of triangles; within one surface, the lower one first.
static constexpr auto fill_pairs = [](int i, const wp::array_t<int>& items, const wp::array_t<wp::int64>& offsets,
                                      const SurfaceTree& surface, const SurfaceTree& tree,
                                      const wp::array_t<float>& slot_boxes, bool itself, double unit,
                                      wp::array_t<int>& out_pairs) {
    wp::int64 at = offsets.data[i];
    visit_pairs(items.data[i], surface, tree, slot_boxes, itself, unit, [&](int slot, int other) {
        const int one = surface.slot_triangle.data[slot], another = tree.slot_triangle.data[other];
        const bool turned = itself && one > another;
        out_pairs.data[2 * at] = turned ? another : one;
        out_pairs.data[2 * at++ + 1] = turned ? one : another;
    });
};

static constexpr auto find_pair = [](int item, const SurfaceTree& surface, const SurfaceTree& tree,
                                     const wp::array_t<float>& slot_boxes, bool itself, double unit,
                                     wp::array_t<int>& out_found) {
    // Another thread may have found a pair already.
    if (out_found.data[0]) return;
    visit_pairs(item, surface, tree, slot_boxes, itself, unit, [&](int, int) { out_found.data[0] = 1; });
};

// Sets out_found if triangles of two bodies may face each other within the margin. Bodies are those of `body`, -1 for
// none, within one surface, else the two surfaces; `sense` is -1 where one of these is inside out.
static constexpr auto find_facing = [](int item, const SurfaceTree& surface, const SurfaceTree& tree,
                                       const wp::array_t<float>& slot_boxes, bool itself, const wp::array_t<int>& body,
                                       double margin, double sense, wp::array_t<int>& out_found) {
    if (out_found.data[0]) return;
    visit_near(item, surface, tree, slot_boxes, itself, margin, [&](int slot, int other) {
        const int *b = body.data, one = itself ? b[surface.slot_triangle.data[slot]] : 0;
        const int another = itself ? b[tree.slot_triangle.data[other]] : 1;
        if (one < 0 || another < 0 || one == another) return;
        const point *t = surface.corners.data + 3 * slot, *u = tree.corners.data + 3 * other;
        // A leaf of a GPU holds several triangles, of which boxes are tested here.
        if (!boxes_meet(t, u, margin)) return;
        const point n = wp::cross(t[1] - t[0], t[2] - t[0]), m = wp::cross(u[1] - u[0], u[2] - u[0]);
        if (sense * wp::dot(n, m) > -FACING * wp::length(n) * wp::length(m)) return;
        // Whether a triangle lies on one side of a plane, farther away than the margin.
        auto beyond = [&](const point& on, const point& normal, const point* q) {
            const double a = wp::dot(normal, q[0] - on), b = wp::dot(normal, q[1] - on), c = wp::dot(normal, q[2] - on);
            return wp::max(wp::min(wp::min(a, b), c), -wp::max(wp::max(a, b), c)) > margin * wp::length(normal);
        };
        if (!beyond(t[0], n, u) && !beyond(u[0], m, t)) out_found.data[0] = 1;
    });
};
