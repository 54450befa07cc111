// The k nearest points on a GPU: short lists by one thread for each query, longer ones by a team, which is a warp with a run
// of adjacent queries.
//
// A team collects the points within a bound in shared memory; it sorts them by (squared distance, index) at the end, and
// when there is no room for more. The bound of a query comes from the one before, so most candidates are among the
// nearest, and the order in which nodes are visited does not matter. On a CPU, where tests run this, a team has one thread.

// The threads of a team, the nodes and leaves that it looks at together, and the bits of those for which something holds.
#if defined(__CUDA_ARCH__)
static constexpr int LANES = 32, NODES = LANES / WIDTH, LEAVES = LANES / LEAF;
static constexpr auto wait_for_all = [] { __syncwarp(); };
static constexpr auto votes_of = [](bool holds) -> unsigned { return __ballot_sync(0xffffffffu, holds); };
static constexpr auto bits_of = [](unsigned votes) -> int { return __popc(votes); };
#else
static constexpr int LANES = 1, NODES = 1, LEAVES = 1;
static constexpr auto wait_for_all = [] {};
static constexpr auto votes_of = [](bool holds) -> unsigned { return holds; };
static constexpr auto bits_of = [](unsigned votes) -> int { return __builtin_popcount(votes); };
#endif
// Nodes that wait: of each of nine levels at most the children of those that are opened together. Leaves that wait.
static constexpr int STACK = 9 * NODES * WIDTH, QUEUE = LEAVES + NODES * WIDTH;
// The number of a node, which has at most 2^24 on its level, and the level above.
static constexpr int LEVEL = 1 << 25;

// Whether the squared distance a of point i comes before b of point j.
static constexpr auto before = [](double a, int i, double b, int j) -> bool { return a < b || (a == b && i < j); };

// The place of a lane's entry among those of all lanes that have one; `count` grows by their number.
static constexpr auto place_of = [](bool has, int lane, int& count) -> int {
    const unsigned votes = votes_of(has);
    const int place = count + bits_of(votes & ((1u << lane) - 1));
    count += bits_of(votes);
    return place;
};

// Squared distance of a point from a box whose sides begin at `side`; no more than that of any point in it.
static constexpr auto box_squared = [](const double* side, double x, double y, double z) -> double {
    auto outside = [](double lower, double upper, double value) {
        const double below = lower - value, above = value - upper, most = below > above ? below : above;
        return most > 0.0 ? most : 0.0;
    };
    const double dx = outside(side[0], side[24], x), dy = outside(side[8], side[32], y),
                 dz = outside(side[16], side[40], z);
    return (dx * dx + dy * dy) + dz * dz;
};

// The leaves that a block of queries is asked about, and the level of the lowest node above them.
struct Span {
    int begin, end, top;
};

static constexpr auto span_of = [](const NearestTree& tree, const NearestQueries& queries, int block) -> Span {
    Span span{0, tree.index.shape[0] / LEAF, 1};
    if (queries.leaves.shape[0] > 0)
        span.begin = queries.leaves.data[block][0], span.end = queries.leaves.data[block][1];
    while (span.begin < span.end && span.begin >> 3 * span.top != (span.end - 1) >> 3 * span.top) ++span.top;
    return span;
};

// Whether a node has such leaves below it.
static constexpr auto is_above = [](const Span& span, int node, int level) -> bool {
    return node >= span.begin >> 3 * level && node <= (span.end - 1) >> 3 * level;
};

// A list of LENGTH entries in registers, sorted by (squared distance, index).
//
// The loops have constant bounds: unrolled, everything stays in registers. A shorter list begins with entries that
// precede every candidate, so that the last entry is always the k-th.
static constexpr auto nearest_alone = [](int query, const NearestTree& tree, const NearestQueries& queries) {
    const int owner = queries.index.data[query];
    if (owner == NONE) return;
    const int k = queries.k, block = query / LEAF, K = LENGTH;
    const int seed = queries.seeded ? block : -1, self = queries.excluded ? owner : -1;
    const double* const own = queries.positions.data + (size_t)block * 3 * LEAF + query % LEAF;
    const double x = own[0], y = own[LEAF], z = own[2 * LEAF];
    const double limit = queries.limit_squared.data[queries.limit_squared.shape[0] > 1 ? owner : 0];
    double* const row = queries.distance.data + (size_t)owner * k;
    int* const indices = queries.indices.data + (size_t)owner * k;
    double bound = limit;
    int bound_index = NONE;
    double squared[K];
    int candidate[K];
    #pragma unroll
    for (int i = 0; i < K; ++i) {
        squared[i] = i < K - k ? -1.0 : limit;
        candidate[i] = i < K - k ? -1 : NONE;
    }
    auto offer = [&](double given, int index) {
        // Entries before the new one stay; the new one replaces the first other entry, and the rest move up by one.
        #pragma unroll
        for (int i = K - 1; i > 0; --i) {
            const bool moves = before(given, index, squared[i - 1], candidate[i - 1]);
            const bool enters = before(given, index, squared[i], candidate[i]);
            squared[i] = moves ? squared[i - 1] : enters ? given : squared[i];
            candidate[i] = moves ? candidate[i - 1] : enters ? index : candidate[i];
        }
        if (before(given, index, squared[0], candidate[0])) squared[0] = given, candidate[0] = index;
        bound = squared[K - 1], bound_index = candidate[K - 1];
    };
    auto scan = [&](int leaf) {
        const double* at = tree.positions.data + (size_t)leaf * 3 * LEAF;
        const int* index = tree.index.data + (size_t)leaf * LEAF;
        for (int i = 0; i < LEAF; ++i) {
            const double dx = at[i] - x, dy = at[LEAF + i] - y, dz = at[2 * LEAF + i] - z;
            const double given = (dx * dx + dy * dy) + dz * dz;
            // The rest of the last leaf is NaN: every comparison with it is false.
            if (given <= bound && index[i] != self && before(given, index[i], bound, bound_index))
                offer(given, index[i]);
        }
    };
    if (seed >= 0) scan(seed);
    const Span span = span_of(tree, queries, block);
    int stack[9 * WIDTH], height = span.begin < span.end;
    signed char level[9 * WIDTH];
    double entry[9 * WIDTH];
    stack[0] = span.begin >> 3 * span.top, level[0] = (signed char)span.top, entry[0] = 0.0;
    while (height > 0) {
        --height;
        if (entry[height] > bound) continue;
        const int n = stack[height], l = level[height];
        if (l == 0) {
            if (n != seed && before(entry[height], tree.least.data[n], bound, bound_index)) scan(n);
            continue;
        }
        const int node = tree.level_first.data[l] + n;
        const double* side = tree.boxes.data + (size_t)node * 6 * WIDTH;
        const int* least = tree.least.data + (size_t)node * WIDTH;
        const int base = height;
        const int below = 3 * (l - 1), from = (span.begin >> below) - WIDTH * n;
        const int to = ((span.end - 1) >> below) - WIDTH * n;
        for (int j = from > 0 ? from : 0; j < WIDTH && j <= to; ++j) {
            const double d = box_squared(side + j, x, y, z);
            if (!before(d, least[j], bound, bound_index)) continue;
            // The nearest child is pushed last; among equals, the first.
            int at = height++;
            for (; at > base && entry[at - 1] <= d; --at)
                stack[at] = stack[at - 1], level[at] = level[at - 1], entry[at] = entry[at - 1];
            stack[at] = WIDTH * n + j, level[at] = (signed char)(l - 1), entry[at] = d;
        }
    }
    #pragma unroll
    for (int i = 0; i < K; ++i)
        if (i >= K - k) {
            row[i - (K - k)] = candidate[i] == NONE ? (double)INFINITY : sqrt(squared[i]);
            indices[i - (K - k)] = candidate[i] == NONE ? -1 : candidate[i];
        }
};

// Bitonic sort of the first entries, a power of two, by (squared distance, index).
static constexpr auto sort_entries = [](double* squared, int* index, int count, int lane) {
    for (int length = 2; length <= count; length *= 2)
        for (int step = length / 2; step > 0; step /= 2) {
            for (int pair = lane; pair < count / 2; pair += LANES) {
                const int a = 2 * pair - (pair & (step - 1)), b = a + step;
                const double da = squared[a], db = squared[b];
                const int ia = index[a], ib = index[b];
                if (before(db, ib, da, ia) == ((a & length) == 0))
                    squared[a] = db, squared[b] = da, index[a] = ib, index[b] = ia;
            }
            wait_for_all();
        }
};

struct alignas(16) Four {
    float a, b, c, d;
};
// The most entries for which counting those before each beats sorting; long lists have no room for keys.
static constexpr int COUNTED = ROOM > 256 ? 0 : 192, KEYS = COUNTED ? ROOM : 4;

static constexpr auto nearest_together = [](int item, const NearestTree& tree, const NearestQueries& queries) {
    const int lane = item % THREADS % LANES, first = item / THREADS * queries.run;
#if defined(__CUDA_ARCH__)
    constexpr int TEAMS = 128 / THREADS;
    __shared__ double shared_squared[TEAMS][ROOM];
    __shared__ Four shared_key[TEAMS][KEYS / 4];
    __shared__ int shared_index[TEAMS][ROOM], shared_order[TEAMS][KEYS];
    __shared__ int shared_stack[TEAMS][STACK], shared_queue[TEAMS][QUEUE];
    const int team = threadIdx.x / THREADS;
    double* const squared = shared_squared[team];
    Four* const keys = shared_key[team];
    int *const index = shared_index[team], *const order = shared_order[team];
    int *const stack = shared_stack[team], *const queue = shared_queue[team];
#else
    double squared[ROOM];
    Four keys[KEYS / 4];
    int index[ROOM], order[KEYS], stack[STACK] = {}, queue[QUEUE] = {};
#endif
    float* const key = (float*)keys;
    // Where lists are so long that a block has room for one team, its other threads have nothing to do.
    if (item % THREADS >= LANES) return;
    const int k = queries.k, block = first / LEAF;
    const double* const own = queries.positions.data + (size_t)block * 3 * LEAF;
    const Span span = span_of(tree, queries, block);
    // Of the query before: its place, and its k-th point, infinitely far away if there was none.
    double last[3] = {}, last_far = -1.0;
    int last_index = NONE;
    for (int query = first; query < first + queries.run && queries.index.data[query] != NONE; ++query) {
        const int owner = queries.index.data[query];
        const double x = own[query % LEAF], y = own[LEAF + query % LEAF], z = own[2 * LEAF + query % LEAF];
        const double limit = queries.limit_squared.data[queries.limit_squared.shape[0] > 1 ? owner : 0];
        const int self = queries.excluded ? owner : -1;
        double bound = limit, sure = limit;
        int bound_index = NONE, size = 0;
        // Sorts what there is and keeps the k nearest, which bound the rest.
        auto keep_nearest = [&] {
            int count = 2;
            while (count < size) count *= 2;
            for (int i = size + lane; i < count; i += LANES) squared[i] = (double)INFINITY, index[i] = NONE;
            wait_for_all();
            sort_entries(squared, index, count, lane);
            for (int i = lane; i < size && COUNTED; i += LANES) key[i] = (float)squared[i], order[i] = i;
            if (size >= k) size = k, bound = squared[k - 1], bound_index = index[k - 1];
            wait_for_all();
        };
        // The order of what there is. The place of an entry is the number of those before it: by float32 keys, where no
        // two are equal.
        auto rank = [&] {
            unsigned left = COUNTED < size;
            if (!left) {
                for (int i = lane; i < size + 4 && i < KEYS; i += LANES)
                    if (i < size) order[i] = NONE;
                    else key[i] = INFINITY;
                wait_for_all();
                for (int i = lane; i < size; i += LANES) {
                    const float own = key[i];
                    int place = 0;
                    for (int j = 0; 4 * j < size; ++j) {
                        const Four four = keys[j];
                        place += (four.a < own) + (four.b < own) + (four.c < own) + (four.d < own);
                    }
                    order[place] = i;
                }
                wait_for_all();
                for (int i = 0; i < size; i += LANES) left |= votes_of(i + lane < size && order[i + lane] == NONE);
            }
            if (left) keep_nearest();
            else if (size >= k) size = k, bound = squared[order[k - 1]], bound_index = index[order[k - 1]];
            wait_for_all();
        };
        auto scan = [&](int leaf, bool has) {
            if (size > ROOM - LEAVES * LEAF) keep_nearest();
            for (int i = lane % LEAF; i < LEAF; i += LANES) {
                const double* at = tree.positions.data + (size_t)leaf * 3 * LEAF + i;
                const double dx = at[0] - x, dy = at[LEAF] - y, dz = at[2 * LEAF] - z;
                const double given = (dx * dx + dy * dy) + dz * dz;
                const int candidate = tree.index.data[(size_t)leaf * LEAF + i];
                // The rest of the last leaf is NaN: every comparison with it is false.
                const bool takes = has && candidate != self && before(given, candidate, bound, bound_index);
                const int to = place_of(takes, lane, size);
                if (takes) squared[to] = given, index[to] = candidate;
                if (takes && COUNTED) key[to] = (float)given;
            }
        };
        // All points within the bound.
        auto find = [&] {
            int height = span.begin < span.end, waiting = 0;
            size = 0;
            if (lane == 0) stack[0] = (span.begin >> 3 * span.top) + LEVEL * span.top;
            wait_for_all();
            while (height + waiting > 0) {
                if (waiting < LEAVES && height > 0) {
                    const int taken = height < NODES ? height : NODES;
                    height -= taken;
                    const bool has = lane / WIDTH < taken;
                    const int node = stack[height + (has ? lane / WIDTH : 0)];
                    const int level = node / LEVEL, n = node % LEVEL;
                    const size_t slot = tree.level_first.data[level] + n;
                    wait_for_all();
                    // The first child is opened first: of equal points, those with the lowest indices.
                    for (int j = WIDTH - 1 - lane % WIDTH; j >= 0; j -= LANES) {
                        const double d = box_squared(tree.boxes.data + slot * 6 * WIDTH + j, x, y, z);
                        const int child = WIDTH * n + j;
                        const bool opens = has && is_above(span, child, level - 1)
                                           && before(d, tree.least.data[slot * WIDTH + j], bound, bound_index);
                        const int leaf_to = place_of(opens && level == 1, lane, waiting);
                        const int to = place_of(opens && level > 1, lane, height);
                        if (opens && level == 1) queue[leaf_to] = child;
                        if (opens && level > 1) stack[to] = child + LEVEL * (level - 1);
                    }
                    wait_for_all();
                }
                if (waiting >= LEAVES || (height == 0 && waiting > 0)) {
                    const int taken = waiting < LEAVES ? waiting : LEAVES;
                    waiting -= taken;
                    const bool has = lane / LEAF < taken;
                    scan(queue[waiting + (has ? lane / LEAF : 0)], has);
                }
            }
            rank();
        };
        // By the triangle inequality the k-th point is no farther than the last query's k-th and that query together.
        const double dx = last[0] - x, dy = last[1] - y, dz = last[2] - z;
        const double gap = (dx * dx + dy * dy) + dz * dz;
        if (query > first && gap <= last_far) {
            // Rounding: a few units in the last place, and what underflows.
            const double most = (sqrt(last_far) + sqrt(gap)) * (1.0 + 1.0e-14);
            sure = most * most + 1.0e-300;
            sure = sure < limit ? sure : limit;
            const double enough = last_far * queries.stretch;
            bound = enough < sure ? enough : sure;
            if (gap == 0.0 && last_index != NONE && last_far <= limit) bound = last_far, bound_index = last_index + 1;
        } else if (span.begin < span.end) {
            // The leaves around the nearest one on the way down.
            int leaf = block;
            if (!queries.seeded) {
                leaf = span.begin >> 3 * span.top;
                for (int level = span.top; level > 0; --level) {
                    const size_t slot = tree.level_first.data[level] + leaf;
                    int best = 0;
                    double nearest = (double)INFINITY;
                    for (int j = 0; j < WIDTH; ++j) {
                        const double d = box_squared(tree.boxes.data + slot * 6 * WIDTH + j, x, y, z);
                        if (d < nearest) nearest = d, best = j;
                    }
                    leaf = WIDTH * leaf + best;
                }
            }
            const int around = (k + 2 * LEAF - 1) / LEAF;
            int from = leaf - (around - (query % LEAF >= LEAF / 2)) / 2;
            from = from < span.end - around ? from : span.end - around;
            from = from > span.begin ? from : span.begin;
            for (int l = from; l < from + around && l < span.end; l += LEAVES) {
                const int mine = l + lane / LEAF;
                const bool has = mine < from + around && mine < span.end;
                scan(has ? mine : l, has);
            }
            rank();
            sure = bound;
            bound_index += size == k;
        }
        find();
        while (size < k && (bound < limit || bound_index < NONE)) {
            bound = bound < sure ? sure : limit, bound_index = NONE;
            find();
        }
        last[0] = x, last[1] = y, last[2] = z;
        last_far = size == k ? bound : (double)INFINITY, last_index = bound_index;
        double* const row = queries.distance.data + (size_t)owner * k;
        int* const indices = queries.indices.data + (size_t)owner * k;
        for (int i = lane; i < k; i += LANES) {
            const int from = i < size && COUNTED ? order[i] : i;
            row[i] = i < size ? sqrt(squared[from]) : (double)INFINITY;
            indices[i] = i < size ? index[from] : -1;
        }
        wait_for_all();
    }
};
