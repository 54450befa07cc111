// Radius search on a CPU: runs of queries in one cell, with the surrounding candidates in a buffer.
#include "core/simd.inl"
#include "points/search/cell_along.inl"
#include "points/search/sort_rows.inl"

constexpr int most_queries = 32, room = 1024;
// Squares of radii beyond these vanish or overflow even in float64: float64 decides everything.
constexpr double LEAST_UNIT = 1e-140, LARGEST_UNIT = 1e140;
// Longer rows are sorted step by step: counting takes time quadratic in their length.
constexpr int RANKED = 128;
// Number of queries between the prefetch of a row and its write, and the most entries of a row that are prefetched.
constexpr int AHEAD = 4, PREFETCHED = 64;

// Queries in one cell, of which `begin` is the first.
struct Run {
    int begin;
    float x[most_queries], y[most_queries], z[most_queries], surely[most_queries], possibly[most_queries];
    double limit[most_queries];
};
// The last block is written whole and padded with points that are within no radius.
struct Candidates {
    alignas(64) float x[room + 32], y[room + 32], z[room + 32];
    alignas(64) int place[room + 32];
};

// One bit for each lane. Compilers use vectors of 512 bits only through these built-in functions.
static constexpr auto at_most = [](v16 d, v16 limit) -> unsigned {
#if defined(__AVX512F__)
    return (unsigned short)__builtin_ia32_cmpps512_mask(d, limit, 18, 0xffff, 4);
#else
    return __builtin_bit_cast(unsigned short, __builtin_convertvector(d <= limit, b16));
#endif
};
static constexpr auto above = [](v16 d, v16 limit) -> unsigned {
#if defined(__AVX512F__)
    return (unsigned short)__builtin_ia32_cmpps512_mask(d, limit, 30, 0xffff, 4);
#else
    return __builtin_bit_cast(unsigned short, __builtin_convertvector(d > limit, b16));
#endif
};

static constexpr auto first_at_or_above = [](const CellGrid& grid, int64_t key) -> int {
    const int64_t bucket = key >> grid.shift;
    int first = grid.start.data[bucket];
    if (key & ((int64_t(1) << grid.shift) - 1))
        for (int last = grid.start.data[bucket + 1]; first < last;) {
            const int middle = first + (last - first) / 2;
            if (grid.key.data[middle] < key) first = middle + 1;
            else last = middle;
        }
    return first;
};

// The inverse of the largest power of two that is not above a positive normal number.
static constexpr auto inverse_power_of_two = [](double value) -> double {
    const uint64_t bits = (uint64_t(2046) << 52) - (__builtin_bit_cast(uint64_t, value) & (uint64_t(0x7ff) << 52));
    return __builtin_bit_cast(double, bits);
};

static constexpr auto store = [](float* to, const double* from, double origin, double scale) {
    const d16 local = (*(const d16*)(from) - (d16)(origin)) * (d16)(scale);
    *(v16*)(to) = __builtin_convertvector(local, v16);
};

static constexpr auto decides = [](const CellGrid& grid, const Queries& queries, const Run& run, int k, int p) -> bool {
    // The positions of padding are -1.
    if (p < 0) return false;
    const double dx = grid.x.data[p] - queries.x.data[k];
    const double dy = grid.y.data[p] - queries.y.data[k];
    const double dz = grid.z.data[p] - queries.z.data[k];
    return (dx * dx + dy * dy) + dz * dz <= run.limit[k - run.begin];
};

// Bit mask of the neighbors of query k among sixteen candidates.
static constexpr auto within = [](const CellGrid& grid, const Queries& queries, const Run& run, const Candidates& near,
                                  int k, int at) -> unsigned {
    const int o = k - run.begin;
    const v16 dx = *(const v16*)(near.x + at) - (v16)(run.x[o]);
    const v16 dy = *(const v16*)(near.y + at) - (v16)(run.y[o]);
    const v16 dz = *(const v16*)(near.z + at) - (v16)(run.z[o]);
    const v16 d = __builtin_elementwise_fma(dx, dx, __builtin_elementwise_fma(dy, dy, dz * dz));
    unsigned inside = at_most(d, (v16)(run.surely[o]));
    for (unsigned doubt = 0xffff & ~(inside | above(d, (v16)(run.possibly[o]))); __builtin_expect(doubt != 0, 0);
         doubt &= doubt - 1) {
        const int lane = __builtin_ctz(doubt);
        inside |= (unsigned)(decides(grid, queries, run, k, near.place[at + lane])) << lane;
    }
    return inside;
};

// Writes the positions of those of sixteen candidates whose bit is set, and returns their number; sixteen entries of
// `to` may be overwritten.
static constexpr auto keep = [](const Candidates& near, int* to, int at, unsigned inside) -> int {
#if defined(__AVX512F__)
    typedef int stored __attribute__((__vector_size__(64)));
    // Packed in a register and stored whole: on AMD's Zen 4 a store that packs takes some hundred cycles.
    *(i16*)(to) = (i16)(__builtin_ia32_compresssi512_mask(*(const stored*)(near.place + at), stored{}, inside));
    return __builtin_popcount(inside);
#else
    int kept = 0;
    for (; inside; inside &= inside - 1) to[kept++] = near.place[at + __builtin_ctz(inside)];
    return kept;
#endif
};

// Writes the positions of the neighbors of query k among the candidates, and returns their number.
static constexpr auto keep_all = [](const CellGrid& grid, const Queries& queries, const Run& run,
                                    const Candidates& near, int k, int length, int* to) -> int {
    int count = 0;
    for (int at = 0; at < length; at += 16)
        count += keep(near, to + count, at, within(grid, queries, run, near, k, at));
    return count;
};

// Calls use(run, near, k, length) with the number of candidates for each query k of a run: once, or several times if
// there are more of them than the buffer holds.
static constexpr auto each_run = [](const Queries& queries, const CellGrid& grid, const wp::array_t<double>& radius,
                                    int first_query, int last_query, auto&& use) {
    CellGrid cells = grid;
    int entered = -1;
    Run run;
    Candidates near;
    const i16 steps = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    const bool grouped = grid.groups.shape[0] > 0;
    for (run.begin = first_query; run.begin < last_query;) {
        const int begin = run.begin;
        if (grouped) enter(grid, queries.group.data[begin], cells, entered);
        const double at[3] = {queries.x.data[begin], queries.y.data[begin], queries.z.data[begin]};
        const int cell[3] = {cell_along(cells, 0, at[0]), cell_along(cells, 1, at[1]), cell_along(cells, 2, at[2])};
        // Float32 coordinates are relative to the first query of the run, in units of about its radius: undecided cases
        // are then rare, whatever the extent of the points. Scaling by a power of two is exact.
        const int first_row = queries.index.data[begin];
        const double unit = radius.data[first_row < radius.shape[0] ? first_row : radius.shape[0] - 1];
        const double scale = unit > LEAST_UNIT && unit < LARGEST_UNIT ? inverse_power_of_two(unit) : 1.0;
        double low[3] = {at[0], at[1], at[2]}, high[3] = {at[0], at[1], at[2]}, reach = 0.0;
        int stop = begin;
        for (; stop < last_query && stop - begin < most_queries; ++stop) {
            const double q[3] = {queries.x.data[stop], queries.y.data[stop], queries.z.data[stop]};
            if (grouped && queries.group.data[stop] != entered) break;
            if (stop > begin
                && (cell_along(cells, 0, q[0]) != cell[0] || cell_along(cells, 1, q[1]) != cell[1]
                    || cell_along(cells, 2, q[2]) != cell[2]))
                break;
            const int row = queries.index.data[stop];
            const double r = radius.data[row < radius.shape[0] ? row : radius.shape[0] - 1];
            const int o = stop - begin;
            run.limit[o] = r * r;
            reach = r > reach ? r : reach;
            double local[3], largest = 0.0;
            for (int axis = 0; axis < 3; ++axis) {
                low[axis] = q[axis] < low[axis] ? q[axis] : low[axis];
                high[axis] = q[axis] > high[axis] ? q[axis] : high[axis];
                local[axis] = (q[axis] - at[axis]) * scale;
                const double size = local[axis] < 0.0 ? -local[axis] : local[axis];
                largest = size > largest ? size : largest;
            }
            run.x[o] = (float)(local[0]), run.y[o] = (float)(local[1]), run.z[o] = (float)(local[2]);
            run.surely[o] = -1.0f, run.possibly[o] = __builtin_inff();
            // See nearness_of in neighbors_kernels.
            const double extent = r * scale;
            if (largest + extent < LARGEST_LOCAL) {
                const double shift = 2.0 * ROUNDING * (largest + extent), square = extent * extent;
                const double doubt = 4.0 * shift * (extent + shift) + 8.0 * ROUNDING * square;
                const double least = (square - doubt) * (1.0 - OUTWARDS);
                const double most = (square + doubt) * (1.0 + OUTWARDS);
                run.surely[o] = least < SMALLEST_SQUARE ? -1.0f : (float)(least);
                run.possibly[o] = most < SMALLEST_SQUARE ? (float)(SMALLEST_SQUARE) : (float)(most);
            }
        }
        reach = reach * (1.0 + REACH_RELATIVE) + REACH_ABSOLUTE;
        bool apart = false;
        int from[3], to[3];
        for (int axis = 0; axis < 3; ++axis) {
            apart |= high[axis] + reach < cells.lower[axis] || low[axis] - reach > cells.upper[axis];
            from[axis] = cell_along(cells, axis, low[axis] - reach);
            to[axis] = cell_along(cells, axis, high[axis] + reach);
        }
        int filled = 0;
        auto flush = [&]() {
            if (filled == 0) return;
            const int padded = (filled + 15) & ~15;
            *(v16*)(near.x + filled) = (v16)(__builtin_inff());
            *(i16*)(near.place + filled) = (i16)(-1);
            for (int k = begin; k < stop; ++k) use(run, near, k, padded);
            filled = 0;
        };
        for (int z = from[2]; z <= to[2] && !apart; ++z)
            for (int y = from[1]; y <= to[1]; ++y) {
                const int64_t row = cells.base + (int64_t(z) * cells.count_y + y) * cells.count_x;
                int p = first_at_or_above(grid, row + from[0]);
                const int row_end = first_at_or_above(grid, row + to[0] + 1);
                while (p < row_end) {
                    const int taken = row_end - p < room - filled ? row_end - p : room - filled;
                    // Whole vectors are copied: entries beyond `taken` are padding or are overwritten.
                    for (int o = 0; o < taken; o += 16) {
                        store(near.x + filled + o, grid.x.data + p + o, at[0], scale);
                        store(near.y + filled + o, grid.y.data + p + o, at[1], scale);
                        store(near.z + filled + o, grid.z.data + p + o, at[2], scale);
                        *(i16*)(near.place + filled + o) = steps + (i16)(p + o);
                    }
                    filled += taken;
                    p += taken;
                    if (filled == room) flush();
                }
            }
        flush();
        run.begin = stop;
    }
};

// Number of neighbors of each query of a share. The neighbors found are noted for the fill, as long as there is space.
//
// The notes hold, for each query, the number of neighbors and their positions among the sorted points. The first entry
// is 1 if the notes of all queries of the share are complete.
static constexpr auto count_share = [](int share, const Queries& queries, const CellGrid& grid,
                                       const wp::array_t<double>& radius, int self_count, int note_size,
                                       wp::array_t<int>& out_count, wp::array_t<int>& out_note) {
    const int first_query = share * SHARE_SIZE, last_query = wp::min(first_query + SHARE_SIZE, queries.index.shape[0]);
    const int64_t begin = (int64_t)(share)*note_size;
    bool whole = begin < out_note.shape[0];
    // Where there is no room for notes, there may be no array: no pointer is formed then.
    int* to = whole ? out_note.data + begin + 1 : nullptr;
    const int* const end = whole ? out_note.data + begin + note_size : nullptr;
    int next = first_query;
    for (int k = first_query; k < last_query; ++k) out_count.data[queries.index.data[k]] = -self_count;
    // Queries come in order; those without candidates are skipped. If the candidates fill the buffer several times, all
    // queries of the run come once for each filling, and nothing is noted.
    each_run(queries, grid, radius, first_query, last_query,
             [&](const Run& run, const Candidates& near, int k, int length) {
                 whole = whole && k >= next && to + (k - next) + 1 + length <= end;
                 int inside = 0;
                 if (whole) {
                     for (; next < k; ++next) *to++ = 0;
                     inside = keep_all(grid, queries, run, near, k, length, to + 1);
                     *to = inside;
                     to += 1 + inside;
                     ++next;
                 } else
                     for (int at = 0; at < length; at += 16)
                         inside += __builtin_popcount(within(grid, queries, run, near, k, at));
                 out_count.data[queries.index.data[k]] += inside;
             });
    if (begin < out_note.shape[0]) {
        whole = whole && to + (last_query - next) <= end;
        for (; whole && next < last_query; ++next) *to++ = 0;
        out_note.data[begin] = whole;
    }
};

// Calls put(k, found, count) with the positions of the neighbors of each query of a share, from the notes of the count
// if they are whole. Queries without neighbors may be left out, and those with many may come several times.
static constexpr auto each_found = [](const Queries& queries, const CellGrid& grid, const wp::array_t<double>& radius,
                                      const wp::array_t<int>& note, int note_size, int share, int first_query,
                                      int last_query, auto&& put) {
    const int64_t begin = (int64_t)(share)*note_size;
    const int* at = note.data + begin;
    if (begin < note.shape[0] && *at++)
        for (int k = first_query; k < last_query; ++k) {
            const int count = *at++;
            if (count) put(k, at, count);
            at += count;
        }
    else {
        alignas(64) int found[room + 32];
        each_run(queries, grid, radius, first_query, last_query,
                 [&](const Run& run, const Candidates& near, int k, int length) {
                     put(k, found, keep_all(grid, queries, run, near, k, length, found));
                 });
    }
};

// For each of at most RANKED keys the number of smaller ones, sixteen keys at a time: no branch depends on the data.
// Both arrays have room for 32 more.
static constexpr auto rank_keys = [](int* key, int count, int* rank) {
    *(i16*)(key + count) = (i16)(0x7fffffff);
    for (int at = 0; at < count; at += 32) {
        const i16 low = *(const i16*)(key + at), high = *(const i16*)(key + at + 16);
        i16 low_rank = 0, high_rank = 0;
        for (int j = 0; j < count; ++j) {
            low_rank -= low > (i16)(key[j]);
            high_rank -= high > (i16)(key[j]);
        }
        *(i16*)(rank + at) = low_rank;
        *(i16*)(rank + at + 16) = high_rank;
    }
};

// Neighbors of each query of a share, from its offset on: by ascending index, or in the order of the cells.
static constexpr auto fill_share = [](int share, const Queries& queries, const CellGrid& grid,
                                      const wp::array_t<double>& radius, int own, const wp::array_t<int64_t>& offset,
                                      int note_size, const wp::array_t<int>& note, bool by_index,
                                      wp::array_t<int>& out_index, auto& out_distance) {
    const int first_query = share * SHARE_SIZE, last_query = wp::min(first_query + SHARE_SIZE, queries.index.shape[0]);
    // Indices and distances found in one filling of the buffer.
    alignas(64) int key[room + 32], rank[RANKED + 32];
    alignas(64) double distance[room + 32];
    int written[SHARE_SIZE];
    // Rows are in the caller's order, scattered over memory, so the rows of upcoming queries are prefetched.
    for (int k = first_query; k < last_query; ++k) {
        written[k - first_query] = 0;
        __builtin_prefetch(offset.data + queries.index.data[k]);
    }
    auto put = [&](int k, const int* found, int count) {
        const int row = queries.index.data[k], without = row + own;
        if (k + AHEAD < last_query) {
            // Prefetch all cache lines of a row, which seldom begins at a line.
            const int next = queries.index.data[k + AHEAD];
            const int64_t row_begin = offset.data[next], length = offset.data[next + 1] - row_begin;
            const int64_t most = length < PREFETCHED ? length : PREFETCHED;
            auto prefetch = [&](const auto* first) {
                const char* const end = (const char*)(first + most) + 63;
                for (const char* line = (const char*)(first); line < end; line += 64) __builtin_prefetch(line, 1);
            };
            prefetch(out_index.data + row_begin);
            prefetch(out_distance.data + row_begin);
        }
        const double x = queries.x.data[k], y = queries.y.data[k], z = queries.z.data[k];
        // Vectorization is off: the compiler would gather here and scatter below. On processors with the microcode
        // mitigation a gather takes ten times as long, and no processor gains from the scatter.
        #pragma clang loop vectorize(disable)
        for (int i = 0; i < count; ++i) {
            const int p = found[i];
            const double dx = grid.x.data[p] - x, dy = grid.y.data[p] - y, dz = grid.z.data[p] - z;
            key[i] = grid.index.data[p];
            distance[i] = (dx * dx + dy * dy) + dz * dz;
        }
        int kept = count;
        if (own >= 0) {
            kept = 0;
            for (int i = 0; i < count; ++i)
                if (key[i] != without) {
                    key[kept] = key[i];
                    distance[kept++] = distance[i];
                }
        }
        for (int i = 0; i < kept; i += 8) *(d8*)(distance + i) = __builtin_elementwise_sqrt(*(const d8*)(distance + i));
        int& so_far = written[k - first_query];
        int* const keys = out_index.data + offset.data[row];
        auto* const values = out_distance.data + offset.data[row];
        if (by_index && so_far == 0 && kept <= RANKED) {
            rank_keys(key, kept, rank);
            #pragma clang loop vectorize(disable)
            for (int i = 0; i < kept; ++i) {
                keys[rank[i]] = key[i];
                values[rank[i]] = distance[i];
            }
        } else {
            for (int i = 0; i < kept; ++i) {
                keys[so_far + i] = key[i];
                values[so_far + i] = distance[i];
            }
            if (by_index) sort_row(keys, values, so_far + kept);
        }
        so_far += kept;
    };
    each_found(queries, grid, radius, note, note_size, share, first_query, last_query, put);
};

// Verlet lists: places of the candidates of each list of a share, from its beginning on, by ascending rank, which is grid.index.
static constexpr auto list_places = [](int share, const Queries& queries, const CellGrid& grid,
                                       const wp::array_t<double>& radius, const wp::array_t<int64_t>& offset,
                                       int note_size, const wp::array_t<int>& note, wp::array_t<int>& out_place) {
    const int first_query = share * SHARE_SIZE, last_query = wp::min(first_query + SHARE_SIZE, queries.index.shape[0]);
    alignas(64) int key[room + 32], rank[RANKED + 32];
    int written[SHARE_SIZE];
    for (int k = first_query; k < last_query; ++k) written[k - first_query] = 0;
    auto put = [&](int k, const int* found, int count) {
        int& so_far = written[k - first_query];
        int* const places = out_place.data + offset.data[queries.index.data[k]];
        if (so_far == 0 && count <= RANKED) {
            // See fill_share.
            #pragma clang loop vectorize(disable)
            for (int i = 0; i < count; ++i) key[i] = grid.index.data[found[i]];
            rank_keys(key, count, rank);
            #pragma clang loop vectorize(disable)
            for (int i = 0; i < count; ++i) places[rank[i]] = found[i];
        } else {
            for (int i = 0; i < count; ++i) places[so_far + i] = found[i];
            // Shell sort, gaps of Tokuda 1992.
            const int total = so_far + count;
            for (int gap = total; gap > 1;) {
                gap = gap <= 32 ? 1 : gap / 9 * 4;
                for (int i = gap; i < total; ++i) {
                    const int moving = places[i], moving_key = grid.index.data[moving];
                    int j = i;
                    for (; j >= gap && grid.index.data[places[j - gap]] > moving_key; j -= gap)
                        places[j] = places[j - gap];
                    places[j] = moving;
                }
            }
        }
        so_far += count;
    };
    each_found(queries, grid, radius, note, note_size, share, first_query, last_query, put);
};
