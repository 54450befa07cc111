// Greedy farthest point sampling: see farthest_points_kernels.
//
// Both devices select the same point: the largest squared distance, among ties the lowest index. A leaf does not
// change, bit for bit, if its box is no nearer to the new point than the leaf's farthest point is to a selected one: no
// minimum inside would change. Leaves have 64 points, groups 64 leaves.
#include "core/simd.inl"

// On a CPU eight boxes or points at a time; on a GPU by the threads of one block, where warp votes select the leaves that
// change.
static constexpr auto take_farthest = [](int, const SampledCloud& cloud, const wp::array_t<int>& start, int count,
                                         wp::array_t<int>& out_index) {
    const double* const x = cloud.x.data;
    const double* const y = cloud.y.data;
    const double* const z = cloud.z.data;
    double* const squared = cloud.squared.data;
    const int* const index = cloud.index.data;
    const int groups = cloud.group_count;
    const int leaves = groups * 64;
    const double* const leaf_box = cloud.leaf_box.data;
    const double* const group_box = cloud.group_box.data;
    double* const leaf_far = cloud.leaf_far.data;
    double* const group_far = cloud.group_far.data;
    int* const leaf_at = cloud.leaf_at.data;
    int* const group_at = cloud.group_at.data;
    const auto keep_better = [&](double& far, int& at, double other_far, int other_at) {
        if (other_at < 0) return;
        if (at < 0 || other_far > far || (other_far == far && index[other_at] < index[at])) {
            far = other_far;
            at = other_at;
        }
    };
    int current = start.data[0];
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31;
    const int team = threadIdx.x >> 5;
    const int teams = blockDim.x >> 5;
    __shared__ double shared_far[32];
    __shared__ int shared_at[32];
    const auto gap = [](const double* box, int stride, int b, double px, double py, double pz) {
        const double gx = fmax(fmax(box[b] - px, px - box[3 * stride + b]), 0.0);
        const double gy = fmax(fmax(box[stride + b] - py, py - box[4 * stride + b]), 0.0);
        const double gz = fmax(fmax(box[2 * stride + b] - pz, pz - box[5 * stride + b]), 0.0);
        return (gx * gx + gy * gy) + gz * gz;
    };
    const auto best_of_team = [&](double& far, int& at) {
        for (int step = 16; step > 0; step >>= 1) {
            const double other_far = __shfl_xor_sync(all, far, step);
            const int other_at = __shfl_xor_sync(all, at, step);
            keep_better(far, at, other_far, other_at);
        }
    };
    for (int taken = 0; taken < count; ++taken) {
        if (threadIdx.x == 0) out_index.data[taken] = index[current];
        const double px = x[current], py = y[current], pz = z[current];
        double far = -2.0;
        int at = -1;
        for (int base = team * 32; base < groups; base += teams * 32) {
            const int mine = base + lane;
            const bool go = mine < groups
                            && (mine == (current >> 12) || gap(group_box, groups, mine, px, py, pz) < group_far[mine]);
            for (unsigned mask = __ballot_sync(all, go); mask; mask &= mask - 1) {
                const int group = base + __ffs(mask) - 1;
                double group_best = -2.0;
                int group_best_at = -1;
                for (int half = 0; half < 64; half += 32) {
                    const int own = group * 64 + half + lane;
                    const bool near = own == (current >> 6) || gap(leaf_box, leaves, own, px, py, pz) < leaf_far[own];
                    for (unsigned wanted = __ballot_sync(all, near); wanted; wanted &= wanted - 1) {
                        const int leaf = group * 64 + half + __ffs(wanted) - 1;
                        double best = -2.0;
                        int best_at = -1;
                        for (int k = lane; k < 64; k += 32) {
                            const int i = leaf * 64 + k;
                            const double dx = x[i] - px, dy = y[i] - py, dz = z[i] - pz;
                            const double d = (dx * dx + dy * dy) + dz * dz;
                            const double old = i == current ? -1.0 : squared[i];
                            const double now = d < old ? d : old;
                            squared[i] = now;
                            keep_better(best, best_at, now, i);
                        }
                        best_of_team(best, best_at);
                        if (lane == 0) {
                            leaf_far[leaf] = best;
                            leaf_at[leaf] = best_at;
                        }
                    }
                    __syncwarp();
                    keep_better(group_best, group_best_at, leaf_far[own], leaf_at[own]);
                }
                best_of_team(group_best, group_best_at);
                if (lane == 0) {
                    group_far[group] = group_best;
                    group_at[group] = group_best_at;
                }
            }
            __syncwarp();
            if (mine < groups) keep_better(far, at, group_far[mine], group_at[mine]);
        }
        best_of_team(far, at);
        if (lane == 0) {
            shared_far[team] = far;
            shared_at[team] = at;
        }
        __syncthreads();
        far = -2.0;
        at = -1;
        for (int k = 0; k < teams; ++k) keep_better(far, at, shared_far[k], shared_at[k]);
        current = at;
        __syncthreads();
    }
#else
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
};
