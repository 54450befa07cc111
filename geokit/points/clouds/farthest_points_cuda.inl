// Greedy farthest point sampling by the threads of one block; warp votes select the leaves that change.
//
// Expects farthest_points.inl, count, out_index.

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
        const bool go =
            mine < groups && (mine == (current >> 12) || gap(group_box, groups, mine, px, py, pz) < group_far[mine]);
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
#endif
