// Triangles that intersect an axis-aligned box, by separating axes in float64.
#include "mesh/bvh/box_walk.inl"

// Calls on_triangle(slot).
static constexpr auto visit_overlaps = [](int item, const wp::array_t<wp::vec3d>& lower,
                                          const wp::array_t<wp::vec3d>& upper, const SurfaceTree& tree,
                                          const wp::array_t<float>& slot_boxes, auto&& on_triangle) {
    const wp::vec3d box_lower = lower.data[item], box_upper = upper.data[item];
    double corner_low[3], corner_high[3];
    float low[3], high[3];
    for (int k = 0; k < 3; ++k) {
        corner_low[k] = box_lower[k];
        corner_high[k] = box_upper[k];
    }
    local_box(tree, corner_low, corner_high, low, high);
    auto meets = [&](int slot) {
        const wp::vec3d a = tree.corners.data[3 * slot], b = tree.corners.data[3 * slot + 1],
                        c = tree.corners.data[3 * slot + 2];
        for (int k = 0; k < 3; ++k)
            if (wp::max(wp::max(a[k], b[k]), c[k]) < box_lower[k] || wp::min(wp::min(a[k], b[k]), c[k]) > box_upper[k])
                return false;
        // Relative to a corner of the triangle: the differences are exact to their last bit.
        const wp::vec3d ab = b - a, ac = c - a, lo = box_lower - a, hi = box_upper - a;
        const double x = wp::max(wp::abs(lo[0]), wp::abs(hi[0])), y = wp::max(wp::abs(lo[1]), wp::abs(hi[1])),
                     z = wp::max(wp::abs(lo[2]), wp::abs(hi[2]));
        const double size = wp::max(wp::max(x, y), z);
        auto apart = [&](const wp::vec3d& n) {
            double box_most = 0.0, box_least = 0.0;
            for (int k = 0; k < 3; ++k) {
                box_most += n[k] * (n[k] > 0.0 ? hi[k] : lo[k]);
                box_least += n[k] * (n[k] > 0.0 ? lo[k] : hi[k]);
            }
            const double bn = wp::dot(n, ab), cn = wp::dot(n, ac);
            const double gap = BOX_GAP_ERROR * (wp::abs(n[0]) + wp::abs(n[1]) + wp::abs(n[2])) * size;
            return wp::min(wp::min(bn, cn), 0.0) > box_most + gap || wp::max(wp::max(bn, cn), 0.0) < box_least - gap;
        };
        if (apart(wp::cross(ab, ac))) return false;
        const wp::vec3d edge[3] = {ab, ac, c - b};
        for (int k = 0; k < 3; ++k)
            if (apart(wp::vec3d(0.0, -edge[k][2], edge[k][1])) || apart(wp::vec3d(edge[k][2], 0.0, -edge[k][0]))
                || apart(wp::vec3d(-edge[k][1], edge[k][0], 0.0)))
                return false;
        return true;
    };
    auto visit = [&](int first) {
    #if defined(__CUDA_ARCH__)
        if (meets(first)) on_triangle(first);
    #else
        const v8* box = (const v8*)(slot_boxes.data + 6 * first);
        const auto near = (box[0] <= high[0]) & (box[1] <= high[1]) & (box[2] <= high[2]) & (box[3] >= low[0])
                          & (box[4] >= low[1]) & (box[5] >= low[2]);
        for (unsigned lanes = mask_of(near); lanes; lanes &= lanes - 1) {
            const int slot = first + __builtin_ctz(lanes);
            if (meets(slot)) on_triangle(slot);
        }
    #endif
    };
    walk_boxes(tree, low, high, visit);
};

static constexpr auto count_overlaps = [](int item, const wp::array_t<wp::vec3d>& lower,
                                          const wp::array_t<wp::vec3d>& upper, const SurfaceTree& tree,
                                          const wp::array_t<float>& slot_boxes, wp::array_t<wp::int64>& out_count) {
    wp::int64 count = 0;
    visit_overlaps(item, lower, upper, tree, slot_boxes, [&](int) { ++count; });
    out_count.data[item] = count;
};

// The key orders by box, then by triangle.
static constexpr auto list_overlaps = [](int item, const wp::array_t<wp::vec3d>& lower,
                                         const wp::array_t<wp::vec3d>& upper, const wp::array_t<wp::int64>& offsets,
                                         const SurfaceTree& tree, const wp::array_t<float>& slot_boxes,
                                         wp::array_t<wp::int64>& out_key) {
    wp::int64 at = offsets.data[item];
    visit_overlaps(item, lower, upper, tree, slot_boxes,
                   [&](int slot) { out_key.data[at++] = (wp::int64)item << 32 | tree.slot_triangle.data[slot]; });
};
