"""The k nearest points on a GPU: a thread for each query, with its list in registers or as a heap in the result.

Neighbouring threads answer neighbouring queries and open much the same nodes. The comparisons are those of
_nearest_kernels, and so are the answers, bit for bit; the text is plain C++ and runs on a CPU too, which tests use.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.points.search.nearest_cpu_kernels import STACK
from geokit.points.search.nearest_tree_kernels import LEAF, NONE, WIDTH, NearestQueries, NearestTree

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Of a thread on a GPU; see docs/design/layers.md.
REGISTERS = 96

# Lists of 8, 16 or 32, sorted by (squared distance, index). The loops have constant ends: unrolled, everything stays in
# registers. A list of fewer begins with entries that nothing is before, so that its last is always the k-th.
_SHORT_LIST = """
    const int K = LENGTH;
    double squared[K];
    int candidate[K];
    #pragma unroll
    for (int i = 0; i < K; ++i) {
        squared[i] = i < K - k ? -1.0 : limit;
        candidate[i] = i < K - k ? -1 : none;
    }
    auto offer = [&](double given, int index) {
        // Entries before the new one stay, it takes the place of the first other, the rest move up by one.
        #pragma unroll
        for (int i = K - 1; i > 0; --i) {
            const bool moves = before(given, index, squared[i - 1], candidate[i - 1]);
            const bool enters = before(given, index, squared[i], candidate[i]);
            squared[i] = moves ? squared[i - 1] : enters ? given : squared[i];
            candidate[i] = moves ? candidate[i - 1] : enters ? index : candidate[i];
        }
        if (before(given, index, squared[0], candidate[0])) { squared[0] = given; candidate[0] = index; }
        bound = squared[K - 1]; bound_index = candidate[K - 1];
    };
    auto finish = [&]() {
        #pragma unroll
        for (int i = 0; i < K; ++i)
            if (i >= K - k) {
                row[i - (K - k)] = candidate[i] == none ? infinite : sqrt(squared[i]);
                indices[i - (K - k)] = candidate[i] == none ? -1 : candidate[i];
            }
    };
"""

# Longer lists are heaps in the rows of the result, the farthest first.
_HEAP = """
    auto sift = [&](int size, double given, int index) {
        int at = 0;
        for (;;) {
            int child = 2 * at + 1;
            if (child >= size) break;
            if (child + 1 < size && before(row[child], indices[child], row[child + 1], indices[child + 1])) ++child;
            if (!before(given, index, row[child], indices[child])) break;
            row[at] = row[child]; indices[at] = indices[child];
            at = child;
        }
        row[at] = given; indices[at] = index;
    };
    for (int i = 0; i < k; ++i) { row[i] = limit; indices[i] = none; }
    auto offer = [&](double given, int index) {
        sift(k, given, index);
        bound = row[0]; bound_index = indices[0];
    };
    auto finish = [&]() {
        for (int size = k - 1; size > 0; --size) {
            const double given = row[size]; const int index = indices[size];
            row[size] = row[0]; indices[size] = indices[0];
            sift(size, given, index);
        }
        for (int i = 0; i < k; ++i) {
            row[i] = indices[i] == none ? infinite : sqrt(row[i]);
            if (indices[i] == none) indices[i] = -1;
        }
    };
"""

_SEARCH = f"""
    const int LEAF = {int(LEAF)}, WIDTH = {int(WIDTH)}, none = {int(NONE)};
    const int k = queries.k, owner = queries.index.data[query];
    const double infinite = 1.0e308 * 10.0;
    const int block = query / LEAF, seed = queries.seeded ? block : -1, self = queries.excluded ? owner : -1;
    const double* own = queries.positions.data + (size_t)block * 3 * LEAF + query % LEAF;
    const double x = own[0], y = own[LEAF], z = own[2 * LEAF];
    const double limit = queries.limit_squared.data[queries.limit_squared.shape[0] > 1 ? owner : 0];
    double* row = queries.distance.data + (size_t)owner * k;
    int* indices = queries.indices.data + (size_t)owner * k;
    double bound = limit;
    int bound_index = none;
    auto before = [](double a, int i, double b, int j) {{ return a < b || (a == b && i < j); }};
    LIST
    auto scan = [&](int leaf) {{
        const double* at = tree.positions.data + (size_t)leaf * 3 * LEAF;
        const int* index = tree.index.data + (size_t)leaf * LEAF;
        for (int i = 0; i < LEAF; ++i) {{
            const double dx = at[i] - x, dy = at[LEAF + i] - y, dz = at[2 * LEAF + i] - z;
            const double given = (dx * dx + dy * dy) + dz * dz;
            // What fills up the last leaf is no number, and no comparison with it holds.
            if (given <= bound && index[i] != self && before(given, index[i], bound, bound_index))
                offer(given, index[i]);
        }}
    }};
    auto outside = [](double lower, double upper, double value) {{
        const double below = lower - value, above = value - upper;
        const double most = below > above ? below : above;
        return most > 0.0 ? most : 0.0;
    }};
    if (seed >= 0) scan(seed);
    int stack[{STACK}], height = 1;
    signed char level[{STACK}];
    double entry[{STACK}];
    stack[0] = 0; level[0] = (signed char)tree.top; entry[0] = 0.0;
    while (height > 0) {{
        --height;
        if (entry[height] > bound) continue;
        const int n = stack[height], l = level[height];
        if (l == 0) {{
            if (n != seed && before(entry[height], tree.least.data[n], bound, bound_index)) scan(n);
            continue;
        }}
        const int node = tree.level_first.data[l] + n;
        const double* side = tree.boxes.data + (size_t)node * 6 * WIDTH;
        const int* least = tree.least.data + (size_t)node * WIDTH;
        const int base = height;
        for (int j = 0; j < WIDTH; ++j) {{
            const double dx = outside(side[j], side[24 + j], x), dy = outside(side[8 + j], side[32 + j], y),
                         dz = outside(side[16 + j], side[40 + j], z);
            const double d = (dx * dx + dy * dy) + dz * dz;
            if (!before(d, least[j], bound, bound_index)) continue;
            // The nearest on top, and of equals the first.
            int at = height++;
            for (; at > base && entry[at - 1] <= d; --at) {{
                entry[at] = entry[at - 1]; stack[at] = stack[at - 1]; level[at] = level[at - 1];
            }}
            entry[at] = d; stack[at] = WIDTH * n + j; level[at] = (signed char)(l - 1);
        }}
    }}
    finish();
"""


@wp.func_native(_SEARCH.replace("LIST", _SHORT_LIST.replace("LENGTH", "8")))
def nearest_8(tree: NearestTree, queries: NearestQueries, query: wp.int32): ...


@wp.func_native(_SEARCH.replace("LIST", _SHORT_LIST.replace("LENGTH", "16")))
def nearest_16(tree: NearestTree, queries: NearestQueries, query: wp.int32): ...


@wp.func_native(_SEARCH.replace("LIST", _SHORT_LIST.replace("LENGTH", "32")))
def nearest_32(tree: NearestTree, queries: NearestQueries, query: wp.int32): ...


@wp.func_native(_SEARCH.replace("LIST", _HEAP))
def nearest_many(tree: NearestTree, queries: NearestQueries, query: wp.int32): ...


@wp.kernel(cuda_max_registers=REGISTERS)
def nearest_8_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """Lists of up to 8."""
    nearest_8(tree, out_queries, first + wp.tid())


@wp.kernel(cuda_max_registers=REGISTERS)
def nearest_16_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """Lists of up to 16."""
    nearest_16(tree, out_queries, first + wp.tid())


@wp.kernel(cuda_max_registers=REGISTERS)
def nearest_32_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """Lists of up to 32."""
    nearest_32(tree, out_queries, first + wp.tid())


@wp.kernel
def nearest_many_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """Lists of any length."""
    nearest_many(tree, out_queries, first + wp.tid())
