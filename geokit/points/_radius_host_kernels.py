"""Radius search on a CPU: queries of one cell share the candidates around it.

The candidates of a cell, some dozen ranges of sorted points, are laid end to end in a buffer that stays in the first
cache; every query of the cell then reads it from front to back, sixteen points at a time, without a branch that
depends on the data. Float32, seen from the cell, decides wherever its error cannot matter, float64 where it can.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.points._cells_kernels import CellGrid
from geokit.points._neighbors_kernels import (
    LARGEST_LOCAL,
    OUTWARDS,
    REACH_ABSOLUTE,
    REACH_RELATIVE,
    ROUNDING,
    SMALLEST_SQUARE,
    Queries,
)
from geokit.points._radius_kernels import SORT_BY_INDEX

# Contracted multiply-adds would round the squared distance once instead of five times.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Queries answered by one item: runs of one cell are cut at its ends, so it is many times a cell's usual share.
SHARE = wp.constant(256)

# What both searches do. `use(k, count)` is called with the buffer's length for each query k of a run, once or, where
# the candidates are more than the buffer holds, several times.
RUNS = """
#if !defined(__CUDA_ARCH__)
    typedef float lanes __attribute__((ext_vector_type(16), aligned(4)));
    typedef int places __attribute__((ext_vector_type(16), aligned(4)));
    typedef bool flags __attribute__((ext_vector_type(16)));
    // One bit for each lane. Compilers use vectors of 512 bits only where they are asked for them by name.
#if defined(__AVX512F__)
    auto at_most = [](lanes d, lanes limit) -> unsigned {
        return (unsigned short)__builtin_ia32_cmpps512_mask(d, limit, 18, 0xffff, 4);
    };
    auto above = [](lanes d, lanes limit) -> unsigned {
        return (unsigned short)__builtin_ia32_cmpps512_mask(d, limit, 30, 0xffff, 4);
    };
#else
    auto at_most = [](lanes d, lanes limit) -> unsigned {
        return __builtin_bit_cast(unsigned short, __builtin_convertvector(d <= limit, flags));
    };
    auto above = [](lanes d, lanes limit) -> unsigned {
        return __builtin_bit_cast(unsigned short, __builtin_convertvector(d > limit, flags));
    };
#endif
    constexpr int most_queries = 32, room = 1024;
    // The last block is written whole, and padded with points that are nobody's neighbours.
    alignas(64) float bx[room + 32], by[room + 32], bz[room + 32];
    alignas(64) int place[room + 32];
    float qx[most_queries], qy[most_queries], qz[most_queries], surely[most_queries], possibly[most_queries];
    double limit[most_queries];
    const places steps = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

    // As cell_along in _cells_kernels: a cell that this finds must be the one that the points were given.
    auto cell_along = [&](int axis, double at) -> int {
        int i = grid.first_cut[axis];
        for (int last = grid.last_cut[axis]; i < last;) {
            const int middle = (i + last + 1) / 2;
            if (grid.cut.data[middle][0] <= at)
                i = middle;
            else
                last = middle - 1;
        }
        const auto& cut = grid.cut.data[i];
        const double top = cut[3] - 1.0, cell = (at - cut[0]) * cut[1];
        return (int)(cut[2]) + (int)(cell > 0.0 ? (cell < top ? cell : top) : 0.0);
    };
    auto first_at_or_above = [&](int64_t key) -> int {
        const int64_t bucket = key >> grid.shift;
        int first = grid.start.data[bucket];
        if (key & ((int64_t(1) << grid.shift) - 1))
            for (int last = grid.start.data[bucket + 1]; first < last;) {
                const int middle = first + (last - first) / 2;
                if (grid.key.data[middle] < key)
                    first = middle + 1;
                else
                    last = middle;
            }
        return first;
    };
    // The inverse of the largest power of two that is not above a positive normal number.
    auto inverse_power_of_two = [](double value) -> double {
        const uint64_t bits = (uint64_t(2046) << 52) - (__builtin_bit_cast(uint64_t, value) & (uint64_t(0x7ff) << 52));
        return __builtin_bit_cast(double, bits);
    };
    auto store = [](float* to, const double* from, double origin, double scale) {
        typedef double doubles __attribute__((ext_vector_type(16), aligned(8)));
        const doubles local = (*(const doubles*)(from) - (doubles)(origin)) * (doubles)(scale);
        *(lanes*)(to) = __builtin_convertvector(local, lanes);
    };
    auto decides = [&](int k, int p) -> bool {
        // Places of the padding are -1.
        if (p < 0)
            return false;
        const double dx = grid.x.data[p] - queries.x.data[k];
        const double dy = grid.y.data[p] - queries.y.data[k];
        const double dz = grid.z.data[p] - queries.z.data[k];
        return (dx * dx + dy * dy) + dz * dz <= limit[k - run];
    };
    // Neighbours among sixteen entries of the buffer, one bit each.
    auto within = [&](int k, int at) -> unsigned {
        const int o = k - run;
        const lanes dx = *(const lanes*)(bx + at) - (lanes)(qx[o]);
        const lanes dy = *(const lanes*)(by + at) - (lanes)(qy[o]);
        const lanes dz = *(const lanes*)(bz + at) - (lanes)(qz[o]);
        const lanes d = __builtin_elementwise_fma(dx, dx, __builtin_elementwise_fma(dy, dy, dz * dz));
        unsigned inside = at_most(d, (lanes)(surely[o]));
        for (unsigned doubt = 0xffff & ~(inside | above(d, (lanes)(possibly[o]))); __builtin_expect(doubt != 0, 0);
             doubt &= doubt - 1) {
            const int lane = __builtin_ctz(doubt);
            inside |= (unsigned)(decides(k, place[at + lane])) << lane;
        }
        return inside;
    };
    auto each_run = [&](auto&& use) {
        for (run = first_query; run < last_query;) {
            const double at[3] = {queries.x.data[run], queries.y.data[run], queries.z.data[run]};
            const int cell[3] = {cell_along(0, at[0]), cell_along(1, at[1]), cell_along(2, at[2])};
            // Float32 sees the run from its first query, in units of about its radius: what it cannot decide is rare,
            // however far the points reach. A power of two rounds nothing.
            const int first_row = queries.index.data[run];
            const double unit = radius.data[first_row < radius.shape[0] ? first_row : radius.shape[0] - 1];
            const double scale = unit > LEAST_UNIT && unit < LARGEST_UNIT ? inverse_power_of_two(unit) : 1.0;
            double low[3] = {at[0], at[1], at[2]}, high[3] = {at[0], at[1], at[2]}, reach = 0.0;
            int stop = run;
            for (; stop < last_query && stop - run < most_queries; ++stop) {
                const double q[3] = {queries.x.data[stop], queries.y.data[stop], queries.z.data[stop]};
                if (stop > run && (cell_along(0, q[0]) != cell[0] || cell_along(1, q[1]) != cell[1] ||
                                   cell_along(2, q[2]) != cell[2]))
                    break;
                const int row = queries.index.data[stop];
                const double r = radius.data[row < radius.shape[0] ? row : radius.shape[0] - 1];
                const int o = stop - run;
                limit[o] = r * r;
                reach = r > reach ? r : reach;
                double local[3], largest = 0.0;
                for (int axis = 0; axis < 3; ++axis) {
                    low[axis] = q[axis] < low[axis] ? q[axis] : low[axis];
                    high[axis] = q[axis] > high[axis] ? q[axis] : high[axis];
                    local[axis] = (q[axis] - at[axis]) * scale;
                    const double size = local[axis] < 0.0 ? -local[axis] : local[axis];
                    largest = size > largest ? size : largest;
                }
                qx[o] = (float)(local[0]), qy[o] = (float)(local[1]), qz[o] = (float)(local[2]);
                surely[o] = -1.0f, possibly[o] = __builtin_inff();
                // See nearness_of in _neighbors_kernels.
                const double extent = r * scale;
                if (largest + extent < LARGEST_LOCAL) {
                    const double shift = 2.0 * ROUNDING * (largest + extent), square = extent * extent;
                    const double doubt = 4.0 * shift * (extent + shift) + 8.0 * ROUNDING * square;
                    const double least = (square - doubt) * (1.0 - OUTWARDS);
                    const double most = (square + doubt) * (1.0 + OUTWARDS);
                    surely[o] = least < SMALLEST_SQUARE ? -1.0f : (float)(least);
                    possibly[o] = most < SMALLEST_SQUARE ? (float)(SMALLEST_SQUARE) : (float)(most);
                }
            }
            reach = reach * (1.0 + REACH_RELATIVE) + REACH_ABSOLUTE;
            bool apart = false;
            int from[3], to[3];
            for (int axis = 0; axis < 3; ++axis) {
                apart |= high[axis] + reach < grid.lower[axis] || low[axis] - reach > grid.upper[axis];
                from[axis] = cell_along(axis, low[axis] - reach);
                to[axis] = cell_along(axis, high[axis] + reach);
            }
            int filled = 0;
            auto flush = [&]() {
                if (filled == 0)
                    return;
                const int padded = (filled + 15) & ~15;
                *(lanes*)(bx + filled) = (lanes)(__builtin_inff());
                *(places*)(place + filled) = (places)(-1);
                for (int k = run; k < stop; ++k)
                    use(k, padded);
                filled = 0;
            };
            for (int z = from[2]; z <= to[2] && !apart; ++z)
                for (int y = from[1]; y <= to[1]; ++y) {
                    const int64_t row = (int64_t(z) * grid.count_y + y) * grid.count_x;
                    int p = first_at_or_above(row + from[0]);
                    const int row_end = first_at_or_above(row + to[0] + 1);
                    while (p < row_end) {
                        const int taken = row_end - p < room - filled ? row_end - p : room - filled;
                        // Whole vectors: what they read or write too much is padding or written again.
                        for (int o = 0; o < taken; o += 16) {
                            store(bx + filled + o, grid.x.data + p + o, at[0], scale);
                            store(by + filled + o, grid.y.data + p + o, at[1], scale);
                            store(bz + filled + o, grid.z.data + p + o, at[2], scale);
                            *(places*)(place + filled + o) = steps + (places)(p + o);
                        }
                        filled += taken;
                        p += taken;
                        if (filled == room)
                            flush();
                    }
                }
            flush();
            run = stop;
        }
    };
#endif
"""

COUNT = (
    "int run = first_query;"
    + RUNS
    + """
#if !defined(__CUDA_ARCH__)
    for (int k = first_query; k < last_query; ++k)
        out_count.data[queries.index.data[k]] = -self_count;
    each_run([&](int k, int length) {
        int inside = 0;
        for (int at = 0; at < length; at += 16)
            inside += __builtin_popcount(within(k, at));
        out_count.data[queries.index.data[k]] += inside;
    });
#endif
"""
)

FILL = (
    "int run = first_query;"
    + RUNS
    + """
#if !defined(__CUDA_ARCH__)
    typedef double doubles __attribute__((ext_vector_type(8), aligned(8)));
    // Neighbours found in one filling of the buffer: where they stand among the sorted points, whose they are, how far.
    alignas(64) int found[room + 32], key[room + 32], rank[RANKED + 32];
    alignas(64) double distance[room + 32];
    int written[SHARE_SIZE];
    auto sort_row = [](int* key, double* value, int count) {SORT};
    // Rows lie in the caller's order, all over the memory: what is needed soon is asked for early.
    for (int k = first_query; k < last_query; ++k) {
        written[k - first_query] = 0;
        __builtin_prefetch(offset.data + queries.index.data[k]);
    }
    each_run([&](int k, int length) {
        const int row = queries.index.data[k], without = row + own;
        if (k + AHEAD < last_query) {
            const int64_t next = offset.data[queries.index.data[k + AHEAD]];
            for (int line = 0; line < 2; ++line)
                __builtin_prefetch(out_index.data + next + 16 * line, 1);
            for (int line = 0; line < 4; ++line)
                __builtin_prefetch(out_distance.data + next + 8 * line, 1);
        }
        const double x = queries.x.data[k], y = queries.y.data[k], z = queries.z.data[k];
        int count = 0;
        for (int at = 0; at < length; at += 16) {
            unsigned inside = within(k, at);
#if defined(__AVX512F__)
            typedef int stored __attribute__((__vector_size__(64)));
            __builtin_ia32_compressstoresi512_mask((stored*)(found + count), *(const stored*)(place + at), inside);
            count += __builtin_popcount(inside);
#else
            for (; inside; inside &= inside - 1)
                found[count++] = place[at + __builtin_ctz(inside)];
#endif
        }
        // The compiler's own vectors would gather here and scatter below. Processors with a mended gather take ten
        // times as long for the one, and none is quicker with the other.
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
        for (int i = 0; i < kept; i += 8)
            *(doubles*)(distance + i) = __builtin_elementwise_sqrt(*(const doubles*)(distance + i));
        int& so_far = written[k - first_query];
        int* const keys = out_index.data + offset.data[row];
        double* const values = out_distance.data + offset.data[row];
        if (so_far == 0 && kept <= RANKED) {
            // A short row is sorted by counting for each entry how many are smaller, sixteen entries at a time: no
            // branch depends on the data.
            *(places*)(key + kept) = (places)(0x7fffffff);
            for (int at = 0; at < kept; at += 32) {
                const places low = *(const places*)(key + at), high = *(const places*)(key + at + 16);
                places low_rank = 0, high_rank = 0;
                for (int j = 0; j < kept; ++j) {
                    low_rank -= low > (places)(key[j]);
                    high_rank -= high > (places)(key[j]);
                }
                *(places*)(rank + at) = low_rank;
                *(places*)(rank + at + 16) = high_rank;
            }
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
            sort_row(keys, values, so_far + kept);
        }
        so_far += kept;
    });
#endif
"""
)

# The searches on a GPU have the same ones; there they are named with what they are for.
NUMBERS = {
    "ROUNDING": float(ROUNDING),
    "OUTWARDS": float(OUTWARDS),
    "LARGEST_LOCAL": float(LARGEST_LOCAL),
    "SMALLEST_SQUARE": float(SMALLEST_SQUARE),
    "REACH_RELATIVE": float(REACH_RELATIVE),
    "REACH_ABSOLUTE": float(REACH_ABSOLUTE),
    "SHARE_SIZE": int(SHARE),
    # Squares of radii beyond these vanish or overflow in float64 already: all is left to it.
    "LEAST_UNIT": 1e-140,
    "LARGEST_UNIT": 1e140,
    # Longer rows are sorted step by step: counting takes the square of their length.
    "RANKED": 128,
    # Queries between a prefetch and the writing of the row.
    "AHEAD": 4,
}
FILL = FILL.replace("{SORT}", "{" + SORT_BY_INDEX + "}")
for _name, _number in NUMBERS.items():
    COUNT = COUNT.replace(_name, repr(_number))
    FILL = FILL.replace(_name, repr(_number))


@wp.func_native(COUNT)
def count_runs(
    queries: Queries,
    grid: CellGrid,
    radius: wp.array(dtype=wp.float64),
    self_count: wp.int32,
    first_query: wp.int32,
    last_query: wp.int32,
    out_count: wp.array(dtype=wp.int32),
): ...


@wp.func_native(FILL)
def fill_runs(
    queries: Queries,
    grid: CellGrid,
    radius: wp.array(dtype=wp.float64),
    own: wp.int32,
    offset: wp.array(dtype=wp.int64),
    first_query: wp.int32,
    last_query: wp.int32,
    out_index: wp.array(dtype=wp.int32),
    out_distance: wp.array(dtype=wp.float64),
): ...


@wp.kernel
def count_runs_kernel(
    first: int,
    queries: Queries,
    grid: CellGrid,
    radius: wp.array(dtype=wp.float64),
    self_count: wp.int32,
    out_count: wp.array(dtype=wp.int32),
):
    """Number of neighbours of SHARE queries each, less ``self_count``."""
    begin = (first + wp.tid()) * SHARE
    end = wp.min(begin + SHARE, queries.index.shape[0])
    count_runs(queries, grid, radius, self_count, begin, end, out_count)


@wp.kernel
def fill_runs_kernel(
    first: int,
    queries: Queries,
    grid: CellGrid,
    radius: wp.array(dtype=wp.float64),
    own: wp.int32,
    offset: wp.array(dtype=wp.int64),
    out_index: wp.array(dtype=wp.int32),
    out_distance: wp.array(dtype=wp.float64),
):
    """Neighbours of SHARE queries, each from its offset on, by ascending index."""
    begin = (first + wp.tid()) * SHARE
    end = wp.min(begin + SHARE, queries.index.shape[0])
    fill_runs(queries, grid, radius, own, offset, begin, end, out_index, out_distance)
