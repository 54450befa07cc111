// Pairs of intersecting triangles for one item: a leaf of eight slots on a CPU, one slot on CUDA.
//
// Pairs of a surface with itself are visited once, from the lower slot. Expects core/simd.inl, triangle_pair.inl and
// local_box.inl; item, surface, tree, slot_boxes, itself, unit; the macro ON_PAIR(slot, other), used with a slot of
// `surface` and one of `tree`. Defines low, high and visit(first) for box_walk.inl; also width, lows, highs and test.
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
        lower[k] = wp::min(wp::min(p[0][k], p[1][k]), p[2][k]);
        upper[k] = wp::max(wp::max(p[0][k], p[1][k]), p[2][k]);
    }
    local_box(tree, lower, upper, lows[lane], highs[lane]);
    for (int k = 0; k < 3; ++k) {
        low[k] = wp::min(low[k], lows[lane][k]);
        high[k] = wp::max(high[k], highs[lane][k]);
    }
}
auto test = [&](int slot, int other) {
    point t[3], u[3];
    for (int k = 0; k < 3; ++k) {
        t[k] = surface.corners.data[3 * slot + k] * unit;
        u[k] = tree.corners.data[3 * other + k] * unit;
    }
    if (!(itself ? meet_beyond_shared(t, u) : triangles_meet(t, u))) return;
    ON_PAIR(slot, other);
};
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
