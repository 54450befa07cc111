// The k nearest points on a CPU: eight queries at a time, their bounds and their lists of candidates.
//
// Candidates are buffered in a row for each query. For sorting they are transposed to lanes, one for each query, where
// a sorting network makes the same comparisons whatever the values: no branch is mispredicted. Groups of sixteen are
// sorted in registers, then merged. SORT_SIXTEEN and MERGE_SIXTEEN are sorting networks for the sixteen values s with
// the candidates m, made of exchange(s[a], m[a], s[b], m[b]).
#include "core/simd.inl"

// Type of the result of comparing doubles: long if that has 64 bits, else long long.
typedef decltype(__builtin_reduce_max(d8() < d8())) i64;
typedef i64 long8 __attribute__((ext_vector_type(8), aligned(8)));

// Nodes that a shared traversal may open without scanning a leaf for any query, and additional nodes for each leaf
// scanned. Beyond them the queries are traversed one by one: they are far apart, or one reaches much farther than the
// others.
constexpr int FREE_VISITS = 96, VISITS_PER_USE = 2;
// Initial guess of the k-th squared distance, as a share of the largest one of the previous group. A larger guess finds
// and sorts more than k points; a smaller one finds fewer, and the search is repeated.
constexpr double GUESS = 1.1;
// Margin for the roundings of a bound by the triangle inequality. Too small a bound is only a wrong guess.
constexpr double SLACK = 1.0 + 1e-12;
// Factor on a guess that was too small, and the number of times it is applied before only the caller's limit remains.
constexpr double WIDER = 4.0;
constexpr int GUESSES = 3;

struct Eight {
    int k, room, owner[8], self[8], size[8];
    double q[3][8], bound[8], reach[8], limit[8];
    i64 bound_index[8];
    // The largest bound.
    double worst;
    i64 worst_index;
    // The leaves between which is searched if the queries have groups.
    bool grouped;
    int first_leaf, leaf_end;
    double row_squared[8][CAPACITY];
    i64 row_candidate[8][CAPACITY];
    alignas(64) d8 squared[CAPACITY];
    alignas(64) long8 candidate[CAPACITY];
};

static constexpr auto by_distance = [](d8& s, long8& m, d8& t, long8& o) {
    const long8 swap = t < s;
    const d8 u = t < s ? t : s;
    t = t < s ? s : t;
    s = u;
    const long8 v = swap ? o : m;
    o = swap ? m : o;
    m = v;
};

static constexpr auto by_both = [](d8& s, long8& m, d8& t, long8& o) {
    const long8 swap = (t < s) | ((t == s) & (o < m));
    const d8 u = swap ? t : s;
    t = swap ? s : t;
    s = u;
    const long8 v = swap ? o : m;
    o = swap ? m : o;
    m = v;
};

// Transposes eight rows to lanes, or lanes to rows.
static constexpr auto turned = [](const d8* r, d8* out) {
    d8 a[8], b[8];
    #pragma unroll
    for (int i = 0; i < 4; ++i) {
        a[i] = __builtin_shufflevector(r[i], r[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
        a[i + 4] = __builtin_shufflevector(r[i], r[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    }
    #pragma unroll
    for (int i = 0; i < 8; i += 4)
        for (int l = 0; l < 2; ++l) {
            b[i + l] = __builtin_shufflevector(a[i + l], a[i + l + 2], 0, 1, 8, 9, 4, 5, 12, 13);
            b[i + l + 2] = __builtin_shufflevector(a[i + l], a[i + l + 2], 2, 3, 10, 11, 6, 7, 14, 15);
        }
    #pragma unroll
    for (int i = 0; i < 8; i += 2) {
        out[i] = __builtin_shufflevector(b[i], b[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
        out[i + 1] = __builtin_shufflevector(b[i], b[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
    }
};

// Sorts n candidates of each query, in lanes.
static constexpr auto sort = [](Eight& e, int n, auto exchange) {
    for (int i = 0; i < n; i += 16) {
        d8 s[16];
        long8 m[16];
        for (int l = 0; l < 16; ++l) {
            s[l] = e.squared[i + l];
            m[l] = e.candidate[i + l];
        }
        SORT_SIXTEEN
        for (int l = 0; l < 16; ++l) {
            e.squared[i + l] = s[l];
            e.candidate[i + l] = m[l];
        }
    }
    for (int half = 16; half < n; half *= 2) {
        // The last merge is needed up to k only.
        const int end = 2 * half < n || n < e.k ? n : e.k;
        // Move the smaller values of two sorted runs to the first run. All entries beyond n are infinite.
        for (int base = 0; base + half < n; base += 2 * half)
            for (int i = 2 * half < n - base ? 0 : 2 * half - (n - base); i < half; ++i)
                exchange(e.squared[base + i], e.candidate[base + i], e.squared[base + 2 * half - 1 - i],
                         e.candidate[base + 2 * half - 1 - i]);
        for (int step = half / 2; step >= 16; step /= 2)
            for (int base = 0; base < end; base += 2 * step)
                for (int i = base; i < base + step && i + step < n; ++i)
                    exchange(e.squared[i], e.candidate[i], e.squared[i + step], e.candidate[i + step]);
        for (int i = 0; i < end; i += 16) {
            d8 s[16];
            long8 m[16];
            for (int l = 0; l < 16; ++l) {
                s[l] = e.squared[i + l];
                m[l] = e.candidate[i + l];
            }
            MERGE_SIXTEEN
            for (int l = 0; l < 16; ++l) {
                e.squared[i + l] = s[l];
                e.candidate[i + l] = m[l];
            }
        }
    }
};

// Sorts the candidates in lanes, tightens the bounds and drops the candidates beyond the k-th.
static constexpr auto settle = [](Eight& e) {
    int most = 0;
    for (int j = 0; j < 8; ++j) most = e.size[j] > most ? e.size[j] : most;
    const int n = (most + 15) / 16 * 16;
    for (int j = 0; j < 8; ++j)
        for (int i = e.size[j]; i < n; ++i) {
            e.row_squared[j][i] = INFINITY;
            e.row_candidate[j][i] = NONE;
        }
    for (int i = 0; i < n; i += 8) {
        d8 r[8];
        for (int j = 0; j < 8; ++j) r[j] = *(const d8*)(e.row_squared[j] + i);
        turned(r, e.squared + i);
        for (int j = 0; j < 8; ++j) r[j] = __builtin_bit_cast(d8, *(const long8*)(e.row_candidate[j] + i));
        turned(r, (d8*)(e.candidate + i));
    }
    sort(e, n, by_distance);
    // Ties among the kept candidates, or between the last of them and the dropped ones, are rare except on lattices.
    long8 tied = (long8)((i64)0);
    for (int i = 0; i + 1 < e.k && i + 1 < n; ++i)
        tied |= (e.squared[i] == e.squared[i + 1]) & (e.candidate[i] != e.candidate[i + 1]);
    for (int i = e.k; i < n; ++i)
        tied |= (e.squared[i] == e.squared[e.k - 1]) & (e.candidate[i] != e.candidate[e.k - 1]);
    if (mask_of(tied)) sort(e, n, by_both);
    for (int j = 0; j < 8; ++j)
        if (e.size[j] >= e.k) {
            e.size[j] = e.k;
            if (e.bound[j] >= 0.0) {
                e.bound[j] = e.squared[e.k - 1][j];
                e.bound_index[j] = e.candidate[e.k - 1][j];
            }
        }
};

// Transposes the kept candidates back to rows.
static constexpr auto put_back = [](Eight& e) {
    for (int i = 0; i < e.k; i += 8) {
        d8 r[8];
        turned(e.squared + i, r);
        for (int j = 0; j < 8; ++j) *(d8*)(e.row_squared[j] + i) = r[j];
        turned((const d8*)(e.candidate + i), r);
        for (int j = 0; j < 8; ++j) *(long8*)(e.row_candidate[j] + i) = __builtin_bit_cast(long8, r[j]);
    }
};

static constexpr auto larger = [](d8 a, d8 b) -> d8 { return a > b ? a : b; };

static constexpr auto widest = [](Eight& e) {
    const d8 limits = *(const d8*)e.bound;
    e.worst = __builtin_reduce_max(limits);
    e.worst_index = __builtin_reduce_max(limits == (d8)(e.worst) ? *(const long8*)e.bound_index : (long8)((i64)-1));
};

// Buffers the points of a leaf that are within the bound of query j.
static constexpr auto scan = [](const NearestTree& tree, Eight& e, int leaf, int j) {
    if (e.size[j] > e.room - LEAF - 8) {
        settle(e);
        put_back(e);
        widest(e);
    }
    const double* at = tree.positions.data + (size_t)leaf * 3 * LEAF;
    const int* index = tree.index.data + (size_t)leaf * LEAF;
    const d8 X = (d8)(e.q[0][j]), Y = (d8)(e.q[1][j]), Z = (d8)(e.q[2][j]), limit = (d8)(e.bound[j]);
    const long8 own = (long8)((i64)e.self[j]);
    int n = e.size[j];
    #pragma unroll
    for (int i = 0; i < LEAF; i += 8) {
        const d8 dx = *(const d8*)(at + i) - X, dy = *(const d8*)(at + LEAF + i) - Y,
                 dz = *(const d8*)(at + 2 * LEAF + i) - Z;
        const d8 s = (dx * dx + dy * dy) + dz * dz;
        const long8 id = __builtin_convertvector(*(const i8*)(index + i), long8);
        const unsigned lanes = mask_of((s <= limit) & (id != own));
#if defined(__AVX512F__)
        // Compress the lanes without a branch for each.
        *(d8*)(e.row_squared[j] + n) = __builtin_ia32_compressdf512_mask(s, s, (unsigned char)lanes);
        *(long8*)(e.row_candidate[j] + n) = __builtin_bit_cast(
            long8, __builtin_ia32_compressdf512_mask(__builtin_bit_cast(d8, id), __builtin_bit_cast(d8, id),
                                                     (unsigned char)lanes));
        n += __builtin_popcount(lanes);
#else
        for (unsigned rest = lanes; rest; rest &= rest - 1) {
            e.row_squared[j][n] = s[__builtin_ctz(rest)];
            e.row_candidate[j][n++] = id[__builtin_ctz(rest)];
        }
#endif
    }
    e.size[j] = n;
};

// One traversal of the tree for the queries in the bits of `open`, whose bound must not be negative. Returns false if
// they have too little in common.
static constexpr auto walk = [](const NearestTree& tree, Eight& e, unsigned open, int seed) -> bool {
    double lower[3], upper[3];
    const bool alone = (open & (open - 1)) == 0;
    for (int axis = 0; axis < 3; ++axis) {
        lower[axis] = INFINITY;
        upper[axis] = -INFINITY;
        for (unsigned rest = open; rest; rest &= rest - 1) {
            const double x = e.q[axis][__builtin_ctz(rest)];
            lower[axis] = x < lower[axis] ? x : lower[axis];
            upper[axis] = x > upper[axis] ? x : upper[axis];
        }
    }
    if (seed >= 0)
        for (unsigned rest = open; rest; rest &= rest - 1) scan(tree, e, seed, __builtin_ctz(rest));
    widest(e);
    if (e.worst == (double)INFINITY) {
        settle(e);
        put_back(e);
        widest(e);
    }
    const d8 LX = (d8)(lower[0]), LY = (d8)(lower[1]), LZ = (d8)(lower[2]);
    const d8 UX = (d8)(upper[0]), UY = (d8)(upper[1]), UZ = (d8)(upper[2]), zero = (d8)(0.0);
    const d8 X = *(const d8*)e.q[0], Y = *(const d8*)e.q[1], Z = *(const d8*)e.q[2];
    int stack[STACK], height = 1, visits = 0, uses = 0;
    signed char level[STACK];
    double entry[STACK];
    stack[0] = 0;
    level[0] = tree.top;
    entry[0] = 0.0;
    if (e.grouped) {
        // The lowest node above all leaves of the group.
        if (e.first_leaf == e.leaf_end) return true;
        int l = 1;
        while (e.first_leaf >> 3 * l != (e.leaf_end - 1) >> 3 * l) ++l;
        stack[0] = e.first_leaf >> 3 * l;
        level[0] = l;
    }
    while (height > 0) {
        --height;
        if (entry[height] > e.worst) continue;
        const int n = stack[height], l = level[height];
        if (!alone && ++visits > FREE_VISITS + VISITS_PER_USE * uses) return false;
        if (l == 0) {
            if (n == seed) continue;
            const double* side = tree.boxes.data + (size_t)(n / WIDTH) * (6 * WIDTH) + n % WIDTH;
            const d8 dx = larger(larger((d8)(side[0]) - X, X - (d8)(side[24])), zero);
            const d8 dy = larger(larger((d8)(side[8]) - Y, Y - (d8)(side[32])), zero);
            const d8 dz = larger(larger((d8)(side[16]) - Z, Z - (d8)(side[40])), zero);
            const d8 s = (dx * dx + dy * dy) + dz * dz, limit = *(const d8*)e.bound;
            const long8 first = (long8)((i64)tree.least.data[n]);
            unsigned rest = mask_of((s < limit) | ((s == limit) & (first < *(const long8*)e.bound_index)));
            for (; rest; rest &= rest - 1) {
                scan(tree, e, n, __builtin_ctz(rest));
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
        unsigned mask = mask_of(s <= (d8)(e.worst));
        if (e.grouped) {
            const int from = (e.first_leaf >> 3 * (l - 1)) - WIDTH * n;
            const int to = ((e.leaf_end - 1) >> 3 * (l - 1)) - WIDTH * n;
            if (from > 0) mask &= ~0u << from;
            if (to < WIDTH - 1) mask &= (2u << to) - 1u;
        }
        for (; mask; mask &= mask - 1) {
            const int j = __builtin_ctz(mask);
            const double d = near[j];
            if (d == e.worst && least[j] >= e.worst_index) continue;
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

// Results of BLOCKS blocks of queries.
static constexpr auto nearest_of_group = [](int group, const NearestTree& tree, const NearestQueries& queries) {
    Eight e;
    const int k = e.k = queries.k;
    e.room = k + (k < 256 ? k : 256) + 2 * LEAF + 16;
    e.grouped = queries.leaves.shape[0] > 0;
    e.first_leaf = e.leaf_end = 0;
    double guess = -1.0, known = (double)INFINITY, known_at[3];
    const int last = (group + 1) * BLOCKS * LEAF;
    for (int begin = group * BLOCKS * LEAF; begin < last && begin < queries.count; begin += 8) {
        const int block = begin / LEAF, seed = queries.seeded ? block : -1;
        int count = queries.count - begin < 8 ? queries.count - begin : 8;
        if (e.grouped) {
            // Blocks of groups may end early. What the queries before found says something about the same group only.
            while (count > 0 && queries.index.data[begin + count - 1] == NONE) --count;
            if (count == 0) continue;
            const auto& own = queries.leaves.data[block];
            if (own[0] != e.first_leaf) {
                guess = -1.0;
                known = (double)INFINITY;
            }
            e.first_leaf = own[0];
            e.leaf_end = own[1];
        }
        for (int j = 0; j < 8; ++j) {
            const int at = begin % LEAF + (j < count ? j : 0);
            for (int axis = 0; axis < 3; ++axis)
                e.q[axis][j] = queries.positions.data[((size_t)block * 3 + axis) * LEAF + at];
            e.owner[j] = queries.index.data[(size_t)block * LEAF + at];
            e.self[j] = queries.excluded ? e.owner[j] : -1;
            e.limit[j] = queries.limit_squared.data[queries.limit_squared.shape[0] > 1 ? e.owner[j] : 0];
            e.reach[j] = guess >= 0.0 && guess < e.limit[j] ? guess : e.limit[j];
            if (known < (double)INFINITY) {
                // Initial bound from the distance to a query whose k-th distance is known. For far queries it is less
                // than a tenth too large.
                // known_at is set wherever known is finite. NOLINTNEXTLINE(clang-analyzer-core.*)
                const double dx = e.q[0][j] - known_at[0], dy = e.q[1][j] - known_at[1], dz = e.q[2][j] - known_at[2];
                const double most = (known + sqrt(dx * dx + dy * dy + dz * dz)) * SLACK;
                if (most * most < e.reach[j]) e.reach[j] = most * most;
            }
            e.size[j] = 0;
        }
        unsigned open = (1u << count) - 1u;
        for (int attempt = 1; open; ++attempt) {
            auto bind = [&](unsigned chosen) {
                for (int j = 0; j < 8; ++j) {
                    e.bound[j] = chosen >> j & 1u ? e.reach[j] : -1.0;
                    e.bound_index[j] = NONE;
                    if (chosen >> j & 1u) e.size[j] = 0;
                }
            };
            bind(open);
            if (!walk(tree, e, open, seed))
                for (unsigned rest = open; rest; rest &= rest - 1) {
                    const int j = __builtin_ctz(rest);
                    bind(1u << j);
                    walk(tree, e, 1u << j, seed);
                }
            for (unsigned rest = open; rest; rest &= rest - 1) {
                const int j = __builtin_ctz(rest);
                if (e.size[j] >= k || !(e.reach[j] < e.limit[j])) {
                    open &= ~(1u << j);
                    continue;
                }
                const double wider = e.reach[j] * WIDER;
                e.reach[j] = attempt < GUESSES && wider > 0.0 && wider < e.limit[j] ? wider : e.limit[j];
            }
        }
        settle(e);
        long8 sizes;
        for (int j = 0; j < 8; ++j) sizes[j] = e.size[j];
        guess = -1.0;
        for (int j = 0; j < count; ++j)
            if (e.size[j] == k && e.squared[k - 1][j] > guess) guess = e.squared[k - 1][j];
        for (int i = 0; i < k; i += 8) {
            d8 lanes[8], r[8];
            long8 m[8];
            for (int l = 0; l < 8; ++l) {
                const long8 missing = (long8)((i64)(i + l)) >= sizes;
                lanes[l] = missing ? (d8)(INFINITY) : __builtin_elementwise_sqrt(e.squared[i + l]);
                m[l] = missing ? (long8)((i64)-1) : e.candidate[i + l];
            }
            const int length = k - i < 8 ? k - i : 8;
            turned(lanes, r);
            for (int j = 0; j < count; ++j) {
                double* row = queries.distance.data + (size_t)e.owner[j] * k + i;
                if (length == 8) *(d8*)row = r[j];
                else
                    for (int l = 0; l < length; ++l) row[l] = r[j][l];
            }
            turned((const d8*)m, r);
            for (int j = 0; j < count; ++j) {
                int* indices = queries.indices.data + (size_t)e.owner[j] * k + i;
                const i8 id = __builtin_convertvector(__builtin_bit_cast(long8, r[j]), i8);
                if (length == 8) *(i8*)indices = id;
                else
                    for (int l = 0; l < length; ++l) indices[l] = id[l];
            }
        }
        guess *= GUESS;
        known = e.size[count - 1] == k ? sqrt(e.squared[k - 1][count - 1]) : (double)INFINITY;
        for (int axis = 0; axis < 3; ++axis) known_at[axis] = e.q[axis][count - 1];
    }
};
