// The k nearest points on a CPU: results of BLOCKS blocks of queries, eight at a time.
//
// Expects nearest_lists_cpu.inl, nearest_walk_cpu.inl, tree, queries, group.

#if !defined(__CUDA_ARCH__)
const bool grouped = queries.leaves.shape[0] > 0;
double guess = -1.0, known = (double)INFINITY, known_at[3];
const int last = (group + 1) * BLOCKS * LEAF;
for (int begin = group * BLOCKS * LEAF; begin < last && begin < queries.count; begin += 8) {
    const int block = begin / LEAF, seed = queries.seeded ? block : -1;
    int count = queries.count - begin < 8 ? queries.count - begin : 8;
    if (grouped) {
        // Blocks of groups may end early. What the queries before found says something about the same group only.
        while (count > 0 && queries.index.data[begin + count - 1] == NONE) --count;
        if (count == 0) continue;
        const auto& own = queries.leaves.data[block];
        if (own[0] != first_leaf) {
            guess = -1.0;
            known = (double)INFINITY;
        }
        first_leaf = own[0];
        leaf_end = own[1];
    }
    for (int j = 0; j < 8; ++j) {
        const int at = begin % LEAF + (j < count ? j : 0);
        for (int axis = 0; axis < 3; ++axis)
            q[axis][j] = queries.positions.data[((size_t)block * 3 + axis) * LEAF + at];
        owner[j] = queries.index.data[(size_t)block * LEAF + at];
        self[j] = queries.excluded ? owner[j] : -1;
        limit[j] = queries.limit_squared.data[queries.limit_squared.shape[0] > 1 ? owner[j] : 0];
        reach[j] = guess >= 0.0 && guess < limit[j] ? guess : limit[j];
        if (known < (double)INFINITY) {
            // Initial bound from the distance to a query whose k-th distance is known. For far queries it is less than
            // a tenth too large.
            // known_at is set wherever known is finite. NOLINTNEXTLINE(clang-analyzer-core.*)
            const double dx = q[0][j] - known_at[0], dy = q[1][j] - known_at[1], dz = q[2][j] - known_at[2];
            const double most = (known + sqrt(dx * dx + dy * dy + dz * dz)) * SLACK;
            if (most * most < reach[j]) reach[j] = most * most;
        }
        size[j] = 0;
    }
    unsigned open = (1u << count) - 1u;
    for (int attempt = 1; open; ++attempt) {
        auto bind = [&](unsigned chosen) {
            for (int j = 0; j < 8; ++j) {
                bound[j] = chosen >> j & 1u ? reach[j] : -1.0;
                bound_index[j] = NONE;
                if (chosen >> j & 1u) size[j] = 0;
            }
        };
        bind(open);
        if (!walk(open, seed))
            for (unsigned rest = open; rest; rest &= rest - 1) {
                const int j = __builtin_ctz(rest);
                bind(1u << j);
                walk(1u << j, seed);
            }
        for (unsigned rest = open; rest; rest &= rest - 1) {
            const int j = __builtin_ctz(rest);
            if (size[j] >= k || !(reach[j] < limit[j])) {
                open &= ~(1u << j);
                continue;
            }
            const double wider = reach[j] * WIDER;
            reach[j] = attempt < GUESSES && wider > 0.0 && wider < limit[j] ? wider : limit[j];
        }
    }
    settle();
    long8 sizes;
    for (int j = 0; j < 8; ++j) sizes[j] = size[j];
    guess = -1.0;
    for (int j = 0; j < count; ++j)
        if (size[j] == k && squared[k - 1][j] > guess) guess = squared[k - 1][j];
    for (int i = 0; i < k; i += 8) {
        d8 lanes[8], r[8];
        long8 m[8];
        for (int l = 0; l < 8; ++l) {
            const long8 missing = (long8)((i64)(i + l)) >= sizes;
            lanes[l] = missing ? (d8)(INFINITY) : __builtin_elementwise_sqrt(squared[i + l]);
            m[l] = missing ? (long8)((i64)-1) : candidate[i + l];
        }
        const int length = k - i < 8 ? k - i : 8;
        turned(lanes, r);
        for (int j = 0; j < count; ++j) {
            double* row = queries.distance.data + (size_t)owner[j] * k + i;
            if (length == 8) *(d8*)row = r[j];
            else
                for (int l = 0; l < length; ++l) row[l] = r[j][l];
        }
        turned((const d8*)m, r);
        for (int j = 0; j < count; ++j) {
            int* indices = queries.indices.data + (size_t)owner[j] * k + i;
            const i8 id = __builtin_convertvector(__builtin_bit_cast(long8, r[j]), i8);
            if (length == 8) *(i8*)indices = id;
            else
                for (int l = 0; l < length; ++l) indices[l] = id[l];
        }
    }
    guess *= GUESS;
    known = size[count - 1] == k ? sqrt(squared[k - 1][count - 1]) : (double)INFINITY;
    for (int axis = 0; axis < 3; ++axis) known_at[axis] = q[axis][count - 1];
}
#endif
