"""The k nearest points on the CPU: eight queries that are near each other share one walk over the tree.

All arithmetic is float64 and rounds in the order that is written, boxes as well as points. Rounding is monotone: the
squared distance of a box, computed as that of a point is, is never above that of a point in it. So no box that holds an
answer is passed over, and no tolerance is needed.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.points.search.nearest_tree_kernels import LEAF, NONE, WIDTH, NearestQueries, NearestTree

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Blocks of 32 queries of an item: what one group of eight finds is the next one's first guess.
BLOCKS = wp.constant(8)
# Open nodes of a walk: each of at most nine levels leaves seven behind.
STACK = 80
# Nodes that a shared walk may open before it must have been of use to someone, and then for each use. Queries that
# are far apart, or of which one reaches much farther than the others, are better off alone.
FREE_VISITS = 96
VISITS_PER_USE = 2
# Candidates that a query may have at a time, for lists of 1024.
CAPACITY = 1024 + 256 + 4 * int(LEAF)
# A first guess of the squared distance of the k-th, as a share of the farthest of the group before: a larger one finds
# more than k and has them sorted, a smaller one finds fewer and looks again.
GUESS = 1.1
# For the roundings of a bound by the triangle inequality. One that is too small all the same is a guess like another.
SLACK = 1.0 + 1e-12
# What a guess that was too small is multiplied with, so many times.
WIDER = 4.0
GUESSES = 3

_TYPES = f"""
    typedef double d8 __attribute__((ext_vector_type(8), aligned(8)));
    // What a comparison of doubles gives: long where that has 64 bits, else long long.
    typedef decltype(__builtin_reduce_max(d8() < d8())) i64;
    typedef i64 l8 __attribute__((ext_vector_type(8), aligned(8)));
    typedef int n8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef bool b8 __attribute__((ext_vector_type(8)));
    const int LEAF = {int(LEAF)}, none = {int(NONE)};
    auto mask_of = [](l8 lanes) {{
        return (unsigned)__builtin_bit_cast(unsigned char, __builtin_convertvector(lanes, b8));
    }};
    auto larger = [](d8 a, d8 b) {{ return a > b ? a : b; }};
"""


def _network(count: int) -> list[tuple[int, int]]:
    """Comparisons of Batcher's odd-even mergesort of a power of two of values."""
    pairs, p = [], 1
    while p < count:
        step = p
        while step >= 1:
            for j in range(step % p, count - step, 2 * step):
                for i in range(j, j + min(step, count - step - j)):
                    if i // (2 * p) == (i + step) // (2 * p):
                        pairs.append((i, i + step))
            step //= 2
        p *= 2
    return pairs


def _exchanges(pairs: list[tuple[int, int]]) -> str:
    return " ".join(f"exchange(s[{a}], m[{a}], s[{b}], m[{b}]);" for a, b in pairs)


_SORT = _exchanges(_network(16))
_MERGE = _exchanges([(i, i + step) for step in (8, 4, 2, 1) for i in range(16) if not i & step])

# Candidates wait in a row for each query. To be sorted they are turned into lanes, one for each query, where a sorting
# network asks the same comparisons of all whatever the values: no branch is mispredicted. Sixteen at a time are sorted
# in registers, and the sorted sixteens merged.
_LISTS = f"""
    double row_squared[8][{CAPACITY}];
    i64 row_candidate[8][{CAPACITY}];
    alignas(64) d8 squared[{CAPACITY}];
    alignas(64) l8 candidate[{CAPACITY}];
    const int room = k + (k < 256 ? k : 256) + 2 * LEAF + 16;
    int size[8];
    auto by_distance = [](d8& s, l8& m, d8& t, l8& o) {{
        const l8 swap = t < s;
        const d8 u = t < s ? t : s; t = t < s ? s : t; s = u;
        const l8 v = swap ? o : m; o = swap ? m : o; m = v;
    }};
    auto by_both = [](d8& s, l8& m, d8& t, l8& o) {{
        const l8 swap = (t < s) | ((t == s) & (o < m));
        const d8 u = swap ? t : s; t = swap ? s : t; s = u;
        const l8 v = swap ? o : m; o = swap ? m : o; m = v;
    }};
    // Rows of eight into lanes, or lanes into rows: the same.
    auto turned = [](const d8* r, d8* out) {{
        d8 a[8], b[8];
        #pragma unroll
        for (int i = 0; i < 4; ++i) {{
            a[i] = __builtin_shufflevector(r[i], r[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
            a[i + 4] = __builtin_shufflevector(r[i], r[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
        }}
        #pragma unroll
        for (int i = 0; i < 8; i += 4)
            for (int l = 0; l < 2; ++l) {{
                b[i + l] = __builtin_shufflevector(a[i + l], a[i + l + 2], 0, 1, 8, 9, 4, 5, 12, 13);
                b[i + l + 2] = __builtin_shufflevector(a[i + l], a[i + l + 2], 2, 3, 10, 11, 6, 7, 14, 15);
            }}
        #pragma unroll
        for (int i = 0; i < 8; i += 2) {{
            out[i] = __builtin_shufflevector(b[i], b[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
            out[i + 1] = __builtin_shufflevector(b[i], b[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
        }}
    }};
    auto sort = [&](int n, auto exchange) {{
        for (int i = 0; i < n; i += 16) {{
            d8 s[16]; l8 m[16];
            for (int l = 0; l < 16; ++l) {{ s[l] = squared[i + l]; m[l] = candidate[i + l]; }}
            {_SORT}
            for (int l = 0; l < 16; ++l) {{ squared[i + l] = s[l]; candidate[i + l] = m[l]; }}
        }}
        for (int half = 16; half < n; half *= 2) {{
            // The last merge is of use up to k only.
            const int end = 2 * half < n || n < k ? n : k;
            // Runs that are sorted against each other: the smaller ones into the first. Beyond n all is infinite.
            for (int base = 0; base + half < n; base += 2 * half)
                for (int i = 2 * half < n - base ? 0 : 2 * half - (n - base); i < half; ++i)
                    exchange(squared[base + i], candidate[base + i],
                             squared[base + 2 * half - 1 - i], candidate[base + 2 * half - 1 - i]);
            for (int step = half / 2; step >= 16; step /= 2)
                for (int base = 0; base < end; base += 2 * step)
                    for (int i = base; i < base + step && i + step < n; ++i)
                        exchange(squared[i], candidate[i], squared[i + step], candidate[i + step]);
            for (int i = 0; i < end; i += 16) {{
                d8 s[16]; l8 m[16];
                for (int l = 0; l < 16; ++l) {{ s[l] = squared[i + l]; m[l] = candidate[i + l]; }}
                {_MERGE}
                for (int l = 0; l < 16; ++l) {{ squared[i + l] = s[l]; candidate[i + l] = m[l]; }}
            }}
        }}
    }};
    // Sorts the candidates in lanes and tightens the bounds; says how many of each query remain.
    auto settle = [&]() {{
        int most = 0;
        for (int j = 0; j < 8; ++j) most = size[j] > most ? size[j] : most;
        const int n = (most + 15) / 16 * 16;
        for (int j = 0; j < 8; ++j)
            for (int i = size[j]; i < n; ++i) {{ row_squared[j][i] = INFINITY; row_candidate[j][i] = none; }}
        for (int i = 0; i < n; i += 8) {{
            d8 r[8];
            for (int j = 0; j < 8; ++j) r[j] = *(const d8*)(row_squared[j] + i);
            turned(r, squared + i);
            for (int j = 0; j < 8; ++j) r[j] = __builtin_bit_cast(d8, *(const l8*)(row_candidate[j] + i));
            turned(r, (d8*)(candidate + i));
        }}
        sort(n, by_distance);
        // Ties among those that stay, or of the last with what is let go of: rare, except on lattices.
        l8 tied = (l8)((i64)0);
        for (int i = 0; i + 1 < k && i + 1 < n; ++i)
            tied |= (squared[i] == squared[i + 1]) & (candidate[i] != candidate[i + 1]);
        for (int i = k; i < n; ++i) tied |= (squared[i] == squared[k - 1]) & (candidate[i] != candidate[k - 1]);
        if (mask_of(tied)) sort(n, by_both);
        for (int j = 0; j < 8; ++j)
            if (size[j] >= k) {{
                size[j] = k;
                if (bound[j] >= 0.0) {{ bound[j] = squared[k - 1][j]; bound_index[j] = candidate[k - 1][j]; }}
            }}
    }};
    // What is left, as rows again.
    auto put_back = [&]() {{
        for (int i = 0; i < k; i += 8) {{
            d8 r[8];
            turned(squared + i, r);
            for (int j = 0; j < 8; ++j) *(d8*)(row_squared[j] + i) = r[j];
            turned((const d8*)(candidate + i), r);
            for (int j = 0; j < 8; ++j) *(l8*)(row_candidate[j] + i) = __builtin_bit_cast(l8, r[j]);
        }}
    }};
"""

_WALK = f"""
    double worst; i64 worst_index;
    auto widest = [&]() {{
        const d8 limits = *(const d8*)bound;
        worst = __builtin_reduce_max(limits);
        worst_index = __builtin_reduce_max(limits == (d8)(worst) ? *(const l8*)bound_index : (l8)((i64)-1));
    }};
    auto scan = [&](int leaf, int j) {{
        if (size[j] > room - LEAF - 8) {{ settle(); put_back(); widest(); }}
        const double* at = tree.positions.data + (size_t)leaf * 3 * LEAF;
        const int* index = tree.index.data + (size_t)leaf * LEAF;
        const d8 X = (d8)(q[0][j]), Y = (d8)(q[1][j]), Z = (d8)(q[2][j]), limit = (d8)(bound[j]);
        const l8 own = (l8)((i64)self[j]);
        int n = size[j];
        #pragma unroll
        for (int i = 0; i < LEAF; i += 8) {{
            const d8 dx = *(const d8*)(at + i) - X, dy = *(const d8*)(at + LEAF + i) - Y,
                     dz = *(const d8*)(at + 2 * LEAF + i) - Z;
            const d8 s = (dx * dx + dy * dy) + dz * dz;
            const l8 id = __builtin_convertvector(*(const n8*)(index + i), l8);
            const unsigned lanes = mask_of((s <= limit) & (id != own));
    #if defined(__AVX512F__)
            // The lanes side by side, without a branch for each.
            *(d8*)(row_squared[j] + n) = __builtin_ia32_compressdf512_mask(s, s, (unsigned char)lanes);
            *(l8*)(row_candidate[j] + n) = __builtin_bit_cast(l8, __builtin_ia32_compressdf512_mask(
                __builtin_bit_cast(d8, id), __builtin_bit_cast(d8, id), (unsigned char)lanes));
            n += __builtin_popcount(lanes);
    #else
            for (unsigned rest = lanes; rest; rest &= rest - 1) {{
                row_squared[j][n] = s[__builtin_ctz(rest)];
                row_candidate[j][n++] = id[__builtin_ctz(rest)];
            }}
    #endif
        }}
        size[j] = n;
    }};
    // The queries whose bound is not negative, `who` of them. False where they have too little in common.
    auto walk = [&](unsigned who, int seed) {{
        double lower[3], upper[3];
        const bool alone = (who & (who - 1)) == 0;
        for (int axis = 0; axis < 3; ++axis) {{
            lower[axis] = INFINITY; upper[axis] = -INFINITY;
            for (unsigned rest = who; rest; rest &= rest - 1) {{
                const double x = q[axis][__builtin_ctz(rest)];
                lower[axis] = x < lower[axis] ? x : lower[axis];
                upper[axis] = x > upper[axis] ? x : upper[axis];
            }}
        }}
        if (seed >= 0) for (unsigned rest = who; rest; rest &= rest - 1) scan(seed, __builtin_ctz(rest));
        widest();
        if (worst == (double)INFINITY) {{ settle(); put_back(); widest(); }}
        const d8 LX = (d8)(lower[0]), LY = (d8)(lower[1]), LZ = (d8)(lower[2]);
        const d8 UX = (d8)(upper[0]), UY = (d8)(upper[1]), UZ = (d8)(upper[2]), zero = (d8)(0.0);
        const d8 X = *(const d8*)q[0], Y = *(const d8*)q[1], Z = *(const d8*)q[2];
        int stack[{STACK}], height = 1, visits = 0, uses = 0;
        signed char level[{STACK}];
        double entry[{STACK}];
        stack[0] = 0; level[0] = tree.top; entry[0] = 0.0;
        while (height > 0) {{
            --height;
            if (entry[height] > worst) continue;
            const int n = stack[height], l = level[height];
            if (!alone && ++visits > {FREE_VISITS} + {VISITS_PER_USE} * uses) return false;
            if (l == 0) {{
                if (n == seed) continue;
                const double* side = tree.boxes.data + (size_t)(n / {int(WIDTH)}) * {6 * int(WIDTH)} + n % {int(WIDTH)};
                const d8 dx = larger(larger((d8)(side[0]) - X, X - (d8)(side[24])), zero);
                const d8 dy = larger(larger((d8)(side[8]) - Y, Y - (d8)(side[32])), zero);
                const d8 dz = larger(larger((d8)(side[16]) - Z, Z - (d8)(side[40])), zero);
                const d8 s = (dx * dx + dy * dy) + dz * dz, limit = *(const d8*)bound;
                const l8 first = (l8)((i64)tree.least.data[n]);
                unsigned rest = mask_of((s < limit) | ((s == limit) & (first < *(const l8*)bound_index)));
                for (; rest; rest &= rest - 1) {{ scan(n, __builtin_ctz(rest)); ++uses; }}
                continue;
            }}
            const int node = tree.level_first.data[l] + n;
            const d8* side = (const d8*)(tree.boxes.data + (size_t)node * {6 * int(WIDTH)});
            const d8 dx = larger(larger(side[0] - UX, LX - side[3]), zero);
            const d8 dy = larger(larger(side[1] - UY, LY - side[4]), zero);
            const d8 dz = larger(larger(side[2] - UZ, LZ - side[5]), zero);
            const d8 s = (dx * dx + dy * dy) + dz * dz;
            const int* least = tree.least.data + {int(WIDTH)} * (size_t)node;
            double near[8];
            *(d8*)near = s;
            const int base = height;
            for (unsigned mask = mask_of(s <= (d8)(worst)); mask; mask &= mask - 1) {{
                const int j = __builtin_ctz(mask);
                const double d = near[j];
                if (d == worst && least[j] >= worst_index) continue;
                // The nearest on top, and of equals the first.
                int at = height++;
                for (; at > base && entry[at - 1] <= d; --at) {{
                    entry[at] = entry[at - 1]; stack[at] = stack[at - 1]; level[at] = level[at - 1];
                }}
                entry[at] = d; stack[at] = {int(WIDTH)} * n + j; level[at] = l - 1;
            }}
        }}
        return true;
    }};
"""

_SEARCH = f"""
    const int k = queries.k;
    double q[3][8], bound[8], reach[8], limit[8];
    i64 bound_index[8];
    int owner[8], self[8];
    {_LISTS}
    {_WALK}
    double guess = -1.0, known = (double)INFINITY, known_at[3];
    const int last = (group + 1) * {int(BLOCKS)} * LEAF;
    for (int begin = group * {int(BLOCKS)} * LEAF; begin < last && begin < queries.count; begin += 8) {{
        const int count = queries.count - begin < 8 ? queries.count - begin : 8;
        const int block = begin / LEAF, seed = queries.seeded ? block : -1;
        for (int j = 0; j < 8; ++j) {{
            const int at = begin % LEAF + (j < count ? j : 0);
            for (int axis = 0; axis < 3; ++axis)
                q[axis][j] = queries.positions.data[((size_t)block * 3 + axis) * LEAF + at];
            owner[j] = queries.index.data[(size_t)block * LEAF + at];
            self[j] = queries.excluded ? owner[j] : -1;
            limit[j] = queries.limit_squared.data[queries.limit_squared.shape[0] > 1 ? owner[j] : 0];
            reach[j] = guess >= 0.0 && guess < limit[j] ? guess : limit[j];
            if (known < (double)INFINITY) {{
                // As near as it is to a query whose k points are known. From far away this is less than a tenth more.
                const double dx = q[0][j] - known_at[0], dy = q[1][j] - known_at[1], dz = q[2][j] - known_at[2];
                const double most = (known + sqrt(dx * dx + dy * dy + dz * dz)) * {SLACK};
                if (most * most < reach[j]) reach[j] = most * most;
            }}
            size[j] = 0;
        }}
        unsigned open = (1u << count) - 1u;
        for (int attempt = 1; open; ++attempt) {{
            auto bind = [&](unsigned who) {{
                for (int j = 0; j < 8; ++j) {{
                    bound[j] = who >> j & 1u ? reach[j] : -1.0;
                    bound_index[j] = none;
                    if (who >> j & 1u) size[j] = 0;
                }}
            }};
            bind(open);
            if (!walk(open, seed))
                for (unsigned rest = open; rest; rest &= rest - 1) {{
                    const int j = __builtin_ctz(rest);
                    bind(1u << j);
                    walk(1u << j, seed);
                }}
            for (unsigned rest = open; rest; rest &= rest - 1) {{
                const int j = __builtin_ctz(rest);
                if (size[j] >= k || !(reach[j] < limit[j])) {{ open &= ~(1u << j); continue; }}
                const double wider = reach[j] * {WIDER};
                reach[j] = attempt < {GUESSES} && wider > 0.0 && wider < limit[j] ? wider : limit[j];
            }}
        }}
        settle();
        l8 sizes;
        for (int j = 0; j < 8; ++j) sizes[j] = size[j];
        guess = -1.0;
        for (int j = 0; j < count; ++j)
            if (size[j] == k && squared[k - 1][j] > guess) guess = squared[k - 1][j];
        for (int i = 0; i < k; i += 8) {{
            d8 lanes[8], r[8];
            l8 m[8];
            for (int l = 0; l < 8; ++l) {{
                const l8 missing = (l8)((i64)(i + l)) >= sizes;
                lanes[l] = missing ? (d8)(INFINITY) : __builtin_elementwise_sqrt(squared[i + l]);
                m[l] = missing ? (l8)((i64)-1) : candidate[i + l];
            }}
            const int length = k - i < 8 ? k - i : 8;
            turned(lanes, r);
            for (int j = 0; j < count; ++j) {{
                double* row = queries.distance.data + (size_t)owner[j] * k + i;
                if (length == 8) *(d8*)row = r[j];
                else for (int l = 0; l < length; ++l) row[l] = r[j][l];
            }}
            turned((const d8*)m, r);
            for (int j = 0; j < count; ++j) {{
                int* indices = queries.indices.data + (size_t)owner[j] * k + i;
                const n8 id = __builtin_convertvector(__builtin_bit_cast(l8, r[j]), n8);
                if (length == 8) *(n8*)indices = id;
                else for (int l = 0; l < length; ++l) indices[l] = id[l];
            }}
        }}
        guess *= {GUESS};
        known = size[count - 1] == k ? sqrt(squared[k - 1][count - 1]) : (double)INFINITY;
        for (int axis = 0; axis < 3; ++axis) known_at[axis] = q[axis][count - 1];
    }}
"""


# Kernels for CUDA are others: vectors of doubles are not for its compiler.
@wp.func_native(f"#if !defined(__CUDA_ARCH__)\n{_TYPES}{_SEARCH}\n#endif\n;")
def nearest_of_group(tree: NearestTree, queries: NearestQueries, group: wp.int32): ...


@wp.kernel
def nearest_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """The nearest points of BLOCKS blocks of queries."""
    nearest_of_group(tree, out_queries, first + wp.tid())
