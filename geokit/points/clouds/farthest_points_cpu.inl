// Greedy farthest point sampling on a CPU, eight boxes or points at a time.
//
// Expects core/simd.inl, farthest_points.inl, count, out_index.

#if !defined(__CUDA_ARCH__)
for (int taken = 0; taken < count; ++taken) {
    out_index.data[taken] = index[current];
    squared[current] = -1.0;
    const d8 px = (d8)(x[current]), py = (d8)(y[current]), pz = (d8)(z[current]);
    const d8 zero = (d8)(0.0);
    // Bit mask of eight boxes that may hold a point to which the new point is the nearest.
    const auto changed = [&](const double* box, const double* far, int stride, int b) {
        const auto beside = [&](int axis, d8 p) {
            const d8 below = *(const d8*)(box + axis * stride + b) - p;
            const d8 above = p - *(const d8*)(box + (3 + axis) * stride + b);
            const d8 outside = below > above ? below : above;
            return outside > zero ? outside : zero;
        };
        const d8 gx = beside(0, px), gy = beside(1, py), gz = beside(2, pz);
        const d8 gap = (gx * gx + gy * gy) + gz * gz;
        return mask_of(gap < *(const d8*)(far + b));
    };
    const int current_leaf = current >> 6, current_group = current >> 12;
    double far = -2.0;
    int at = -1;
    for (int base = 0; base < groups; base += 8) {
        unsigned wanted = changed(group_box, group_far, groups, base);
        // The selected point is removed from its own boxes even if all of their points are equal.
        if ((current_group & ~7) == base) wanted |= 1u << (current_group & 7);
        for (; wanted; wanted &= wanted - 1) {
            const int group = base + __builtin_ctz(wanted);
            for (int row = group * 64; row < group * 64 + 64; row += 8) {
                unsigned near = changed(leaf_box, leaf_far, leaves, row);
                if ((current_leaf & ~7) == row) near |= 1u << (current_leaf & 7);
                for (; near; near &= near - 1) {
                    const int leaf = row + __builtin_ctz(near);
                    d8 most = (d8)(-1.0);
                    for (int k = leaf * 64; k < leaf * 64 + 64; k += 8) {
                        const d8 dx = *(const d8*)(x + k) - px;
                        const d8 dy = *(const d8*)(y + k) - py;
                        const d8 dz = *(const d8*)(z + k) - pz;
                        const d8 d = (dx * dx + dy * dy) + dz * dz;
                        const d8 old = *(const d8*)(squared + k);
                        const d8 now = d < old ? d : old;
                        *(d8*)(squared + k) = now;
                        most = now > most ? now : most;
                    }
                    double best = most[0];
                    for (int k = 1; k < 8; ++k) best = most[k] > best ? most[k] : best;
                    int best_at = -1;
                    for (int k = leaf * 64; k < leaf * 64 + 64; ++k)
                        if (squared[k] == best && (best_at < 0 || index[k] < index[best_at])) best_at = k;
                    leaf_far[leaf] = best;
                    leaf_at[leaf] = best_at;
                }
            }
            double best = -2.0;
            int best_at = -1;
            for (int leaf = group * 64; leaf < group * 64 + 64; ++leaf)
                keep_better(best, best_at, leaf_far[leaf], leaf_at[leaf]);
            group_far[group] = best;
            group_at[group] = best_at;
        }
        for (int group = base; group < base + 8; ++group) keep_better(far, at, group_far[group], group_at[group]);
    }
    current = at;
}
#endif
