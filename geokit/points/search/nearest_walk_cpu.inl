// The k nearest points on a CPU: one traversal of the tree for several of the eight queries.
//
// Expects nearest_lists_cpu.inl, tree, queries. Defines walk(open, seed), and first_leaf and leaf_end, between which the
// leaves are searched if the queries have groups.

#if !defined(__CUDA_ARCH__)
int first_leaf = 0, leaf_end = 0;
auto larger = [](d8 a, d8 b) { return a > b ? a : b; };
double worst;
i64 worst_index;
auto widest = [&]() {
    const d8 limits = *(const d8*)bound;
    worst = __builtin_reduce_max(limits);
    worst_index = __builtin_reduce_max(limits == (d8)(worst) ? *(const long8*)bound_index : (long8)((i64)-1));
};
auto scan = [&](int leaf, int j) {
    if (size[j] > room - LEAF - 8) {
        settle();
        put_back();
        widest();
    }
    const double* at = tree.positions.data + (size_t)leaf * 3 * LEAF;
    const int* index = tree.index.data + (size_t)leaf * LEAF;
    const d8 X = (d8)(q[0][j]), Y = (d8)(q[1][j]), Z = (d8)(q[2][j]), limit = (d8)(bound[j]);
    const long8 own = (long8)((i64)self[j]);
    int n = size[j];
    #pragma unroll
    for (int i = 0; i < LEAF; i += 8) {
        const d8 dx = *(const d8*)(at + i) - X, dy = *(const d8*)(at + LEAF + i) - Y,
                 dz = *(const d8*)(at + 2 * LEAF + i) - Z;
        const d8 s = (dx * dx + dy * dy) + dz * dz;
        const long8 id = __builtin_convertvector(*(const i8*)(index + i), long8);
        const unsigned lanes = mask_of((s <= limit) & (id != own));
#if defined(__AVX512F__)
        // Compress the lanes without a branch for each.
        *(d8*)(row_squared[j] + n) = __builtin_ia32_compressdf512_mask(s, s, (unsigned char)lanes);
        *(long8*)(row_candidate[j] + n) = __builtin_bit_cast(
            long8, __builtin_ia32_compressdf512_mask(__builtin_bit_cast(d8, id), __builtin_bit_cast(d8, id),
                                                     (unsigned char)lanes));
        n += __builtin_popcount(lanes);
#else
        for (unsigned rest = lanes; rest; rest &= rest - 1) {
            row_squared[j][n] = s[__builtin_ctz(rest)];
            row_candidate[j][n++] = id[__builtin_ctz(rest)];
        }
#endif
    }
    size[j] = n;
};
// For the queries in the bits of `open`, whose bound must not be negative. Returns false if they have too little in
// common.
auto walk = [&](unsigned open, int seed) {
    double lower[3], upper[3];
    const bool alone = (open & (open - 1)) == 0;
    for (int axis = 0; axis < 3; ++axis) {
        lower[axis] = INFINITY;
        upper[axis] = -INFINITY;
        for (unsigned rest = open; rest; rest &= rest - 1) {
            const double x = q[axis][__builtin_ctz(rest)];
            lower[axis] = x < lower[axis] ? x : lower[axis];
            upper[axis] = x > upper[axis] ? x : upper[axis];
        }
    }
    if (seed >= 0)
        for (unsigned rest = open; rest; rest &= rest - 1) scan(seed, __builtin_ctz(rest));
    widest();
    if (worst == (double)INFINITY) {
        settle();
        put_back();
        widest();
    }
    const d8 LX = (d8)(lower[0]), LY = (d8)(lower[1]), LZ = (d8)(lower[2]);
    const d8 UX = (d8)(upper[0]), UY = (d8)(upper[1]), UZ = (d8)(upper[2]), zero = (d8)(0.0);
    const d8 X = *(const d8*)q[0], Y = *(const d8*)q[1], Z = *(const d8*)q[2];
    int stack[STACK], height = 1, visits = 0, uses = 0;
    signed char level[STACK];
    double entry[STACK];
    stack[0] = 0;
    level[0] = tree.top;
    entry[0] = 0.0;
    const bool part = queries.leaves.shape[0] > 0;
    if (part) {
        // The lowest node above all leaves of the group.
        if (first_leaf == leaf_end) return true;
        int l = 1;
        while (first_leaf >> 3 * l != (leaf_end - 1) >> 3 * l) ++l;
        stack[0] = first_leaf >> 3 * l;
        level[0] = l;
    }
    while (height > 0) {
        --height;
        if (entry[height] > worst) continue;
        const int n = stack[height], l = level[height];
        if (!alone && ++visits > FREE_VISITS + VISITS_PER_USE * uses) return false;
        if (l == 0) {
            if (n == seed) continue;
            const double* side = tree.boxes.data + (size_t)(n / WIDTH) * (6 * WIDTH) + n % WIDTH;
            const d8 dx = larger(larger((d8)(side[0]) - X, X - (d8)(side[24])), zero);
            const d8 dy = larger(larger((d8)(side[8]) - Y, Y - (d8)(side[32])), zero);
            const d8 dz = larger(larger((d8)(side[16]) - Z, Z - (d8)(side[40])), zero);
            const d8 s = (dx * dx + dy * dy) + dz * dz, limit = *(const d8*)bound;
            const long8 first = (long8)((i64)tree.least.data[n]);
            unsigned rest = mask_of((s < limit) | ((s == limit) & (first < *(const long8*)bound_index)));
            for (; rest; rest &= rest - 1) {
                scan(n, __builtin_ctz(rest));
                ++uses;
            }
            continue;
        }
        const int node = tree.level_first.data[l] + n;
        const d8* side = (const d8*)(tree.boxes.data + (size_t)node * (6 * WIDTH));
        const d8 dx = larger(larger(side[0] - UX, LX - side[3]), zero);
        const d8 dy = larger(larger(side[1] - UY, LY - side[4]), zero);
        const d8 dz = larger(larger(side[2] - UZ, LZ - side[5]), zero);
        const d8 s = (dx * dx + dy * dy) + dz * dz;
        const int* least = tree.least.data + WIDTH * (size_t)node;
        double near[8];
        *(d8*)near = s;
        const int base = height;
        unsigned mask = mask_of(s <= (d8)(worst));
        if (part) {
            const int from = (first_leaf >> 3 * (l - 1)) - WIDTH * n, to = ((leaf_end - 1) >> 3 * (l - 1)) - WIDTH * n;
            if (from > 0) mask &= ~0u << from;
            if (to < WIDTH - 1) mask &= (2u << to) - 1u;
        }
        for (; mask; mask &= mask - 1) {
            const int j = __builtin_ctz(mask);
            const double d = near[j];
            if (d == worst && least[j] >= worst_index) continue;
            // The nearest child is pushed last; among equals, the first.
            int at = height++;
            for (; at > base && entry[at - 1] <= d; --at) {
                entry[at] = entry[at - 1];
                stack[at] = stack[at - 1];
                level[at] = level[at - 1];
            }
            entry[at] = d;
            stack[at] = WIDTH * n + j;
            level[at] = l - 1;
        }
    }
    return true;
};
#endif
