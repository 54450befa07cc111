// The k nearest points on a GPU: one thread's traversal of the tree, with a list in registers or a heap in the result.

// A query and its bound; `row` and `indices` are its row of the result.
struct Query {
    int k, block, seed, self;
    double x, y, z, limit;
    double* row;
    int* indices;
    double bound;
    int bound_index;
};

// Whether the squared distance a of point i comes before b of point j.
static constexpr auto before = [](double a, int i, double b, int j) -> bool { return a < b || (a == b && i < j); };

// Reads a query; false where the number is one of the rest of a block.
static constexpr auto read_query = [](const NearestQueries& queries, int query, Query& q) -> bool {
    const int owner = queries.index.data[query];
    if (owner == NONE) return false;
    q.k = queries.k;
    q.block = query / LEAF;
    q.seed = queries.seeded ? q.block : -1;
    q.self = queries.excluded ? owner : -1;
    const double* own = queries.positions.data + (size_t)q.block * 3 * LEAF + query % LEAF;
    q.x = own[0], q.y = own[LEAF], q.z = own[2 * LEAF];
    q.limit = queries.limit_squared.data[queries.limit_squared.shape[0] > 1 ? owner : 0];
    q.row = queries.distance.data + (size_t)owner * q.k;
    q.indices = queries.indices.data + (size_t)owner * q.k;
    q.bound = q.limit;
    q.bound_index = NONE;
    return true;
};

static constexpr auto outside = [](double lower, double upper, double value) -> double {
    const double below = lower - value, above = value - upper;
    const double most = below > above ? below : above;
    return most > 0.0 ? most : 0.0;
};

// Calls offer(given, index), which tightens the bound, for every point that may be among the nearest.
static constexpr auto search = [](const NearestTree& tree, const NearestQueries& queries, const Query& q,
                                  auto&& offer) {
    const double x = q.x, y = q.y, z = q.z;
    const int self = q.self, seed = q.seed;
    // Within the search: as a function of its own it made lists of 32 a fifth slower on an H200.
    auto scan = [&](int leaf) {
        const double* at = tree.positions.data + (size_t)leaf * 3 * LEAF;
        const int* index = tree.index.data + (size_t)leaf * LEAF;
        for (int i = 0; i < LEAF; ++i) {
            const double dx = at[i] - x, dy = at[LEAF + i] - y, dz = at[2 * LEAF + i] - z;
            const double given = (dx * dx + dy * dy) + dz * dz;
            // The rest of the last leaf is NaN: every comparison with it is false.
            if (given <= q.bound && index[i] != self && before(given, index[i], q.bound, q.bound_index))
                offer(given, index[i]);
        }
    };
    if (seed >= 0) scan(seed);
    int stack[STACK], height = 1;
    signed char level[STACK];
    double entry[STACK];
    stack[0] = 0;
    level[0] = (signed char)tree.top;
    entry[0] = 0.0;
    const bool part = queries.leaves.shape[0] > 0;
    int first_leaf = 0, leaf_end = 0;
    if (part) {
        // The lowest node above all leaves of the group.
        first_leaf = queries.leaves.data[q.block][0];
        leaf_end = queries.leaves.data[q.block][1];
        int l = 1;
        while (first_leaf < leaf_end && first_leaf >> 3 * l != (leaf_end - 1) >> 3 * l) ++l;
        stack[0] = first_leaf >> 3 * l;
        level[0] = (signed char)l;
        if (first_leaf == leaf_end) height = 0;
    }
    while (height > 0) {
        --height;
        if (entry[height] > q.bound) continue;
        const int n = stack[height], l = level[height];
        if (l == 0) {
            if (n != seed && before(entry[height], tree.least.data[n], q.bound, q.bound_index)) scan(n);
            continue;
        }
        const int node = tree.level_first.data[l] + n;
        const double* side = tree.boxes.data + (size_t)node * 6 * WIDTH;
        const int* least = tree.least.data + (size_t)node * WIDTH;
        const int base = height;
        int from = 0, to = WIDTH - 1;
        if (part) {
            from = (first_leaf >> 3 * (l - 1)) - WIDTH * n;
            to = ((leaf_end - 1) >> 3 * (l - 1)) - WIDTH * n;
            from = from > 0 ? from : 0;
            to = to < WIDTH - 1 ? to : WIDTH - 1;
        }
        for (int j = from; j <= to; ++j) {
            const double dx = outside(side[j], side[24 + j], x), dy = outside(side[8 + j], side[32 + j], y),
                         dz = outside(side[16 + j], side[40 + j], z);
            const double d = (dx * dx + dy * dy) + dz * dz;
            if (!before(d, least[j], q.bound, q.bound_index)) continue;
            // The nearest child is pushed last; among equals, the first.
            int at = height++;
            for (; at > base && entry[at - 1] <= d; --at) {
                entry[at] = entry[at - 1];
                stack[at] = stack[at - 1];
                level[at] = level[at - 1];
            }
            entry[at] = d;
            stack[at] = WIDTH * n + j;
            level[at] = (signed char)(l - 1);
        }
    }
};

// A list of LENGTH entries in registers, sorted by (squared distance, index).
//
// The loops have constant bounds: unrolled, everything stays in registers. A shorter list begins with entries that
// precede every candidate, so that the last entry is always the k-th.
static constexpr auto nearest_short = [](int query, const NearestTree& tree, const NearestQueries& queries) {
    Query q;
    if (!read_query(queries, query, q)) return;
    const int K = LENGTH;
    double squared[K];
    int candidate[K];
    #pragma unroll
    for (int i = 0; i < K; ++i) {
        squared[i] = i < K - q.k ? -1.0 : q.limit;
        candidate[i] = i < K - q.k ? -1 : NONE;
    }
    search(tree, queries, q, [&](double given, int index) {
        // Entries before the new one stay; the new one replaces the first other entry, and the rest move up by one.
        #pragma unroll
        for (int i = K - 1; i > 0; --i) {
            const bool moves = before(given, index, squared[i - 1], candidate[i - 1]);
            const bool enters = before(given, index, squared[i], candidate[i]);
            squared[i] = moves ? squared[i - 1] : enters ? given : squared[i];
            candidate[i] = moves ? candidate[i - 1] : enters ? index : candidate[i];
        }
        if (before(given, index, squared[0], candidate[0])) {
            squared[0] = given;
            candidate[0] = index;
        }
        q.bound = squared[K - 1];
        q.bound_index = candidate[K - 1];
    });
    #pragma unroll
    for (int i = 0; i < K; ++i)
        if (i >= K - q.k) {
            q.row[i - (K - q.k)] = candidate[i] == NONE ? (double)INFINITY : sqrt(squared[i]);
            q.indices[i - (K - q.k)] = candidate[i] == NONE ? -1 : candidate[i];
        }
};

// Puts an entry on top of a heap, the farthest on top, and lets it sink.
static constexpr auto sift = [](double* row, int* indices, int size, double given, int index) {
    int at = 0;
    for (;;) {
        int child = 2 * at + 1;
        if (child >= size) break;
        if (child + 1 < size && before(row[child], indices[child], row[child + 1], indices[child + 1])) ++child;
        if (!before(given, index, row[child], indices[child])) break;
        row[at] = row[child];
        indices[at] = indices[child];
        at = child;
    }
    row[at] = given;
    indices[at] = index;
};

// A list of any length, as a heap in the rows of the result.
static constexpr auto nearest_many = [](int query, const NearestTree& tree, const NearestQueries& queries) {
    Query q;
    if (!read_query(queries, query, q)) return;
    double* const row = q.row;
    int* const indices = q.indices;
    for (int i = 0; i < q.k; ++i) {
        row[i] = q.limit;
        indices[i] = NONE;
    }
    search(tree, queries, q, [&](double given, int index) {
        sift(row, indices, q.k, given, index);
        q.bound = row[0];
        q.bound_index = indices[0];
    });
    for (int size = q.k - 1; size > 0; --size) {
        const double given = row[size];
        const int index = indices[size];
        row[size] = row[0];
        indices[size] = indices[0];
        sift(row, indices, size, given, index);
    }
    for (int i = 0; i < q.k; ++i) {
        row[i] = indices[i] == NONE ? (double)INFINITY : sqrt(row[i]);
        if (indices[i] == NONE) indices[i] = -1;
    }
};
