// Radius search on a CPU: runs of queries in one cell, with the surrounding candidates in a buffer.
//
// Expects core/simd.inl, cells_of_group_cpu.inl, cell_along_cpu.inl, grid, queries, radius, first_query, last_query and the constants of
// radius_cpu_kernels. Defines run, the buffer (bx, by, bz, place), within(k, at): the neighbors of query k among
// sixteen entries of the buffer, one bit each; and each_run(use), which calls use(k, count) with the buffer's length
// for each query k of a run: once, or several times if there are more candidates than the buffer holds.

int run = first_query;
#if !defined(__CUDA_ARCH__)
// One bit for each lane. Compilers use vectors of 512 bits only through these built-in functions.
#if defined(__AVX512F__)
auto at_most = [](v16 d, v16 limit) -> unsigned {
    return (unsigned short)__builtin_ia32_cmpps512_mask(d, limit, 18, 0xffff, 4);
};
auto above = [](v16 d, v16 limit) -> unsigned {
    return (unsigned short)__builtin_ia32_cmpps512_mask(d, limit, 30, 0xffff, 4);
};
#else
auto at_most = [](v16 d, v16 limit) -> unsigned {
    return __builtin_bit_cast(unsigned short, __builtin_convertvector(d <= limit, b16));
};
auto above = [](v16 d, v16 limit) -> unsigned {
    return __builtin_bit_cast(unsigned short, __builtin_convertvector(d > limit, b16));
};
#endif
constexpr int most_queries = 32, room = 1024;
// The last block is written whole and padded with points that are within no radius.
alignas(64) float bx[room + 32], by[room + 32], bz[room + 32];
alignas(64) int place[room + 32];
float qx[most_queries], qy[most_queries], qz[most_queries], surely[most_queries], possibly[most_queries];
double limit[most_queries];
const i16 steps = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
auto first_at_or_above = [&](int64_t key) -> int {
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
auto inverse_power_of_two = [](double value) -> double {
    const uint64_t bits = (uint64_t(2046) << 52) - (__builtin_bit_cast(uint64_t, value) & (uint64_t(0x7ff) << 52));
    return __builtin_bit_cast(double, bits);
};
auto store = [](float* to, const double* from, double origin, double scale) {
    const d16 local = (*(const d16*)(from) - (d16)(origin)) * (d16)(scale);
    *(v16*)(to) = __builtin_convertvector(local, v16);
};
auto decides = [&](int k, int p) -> bool {
    // The positions of padding are -1.
    if (p < 0) return false;
    const double dx = grid.x.data[p] - queries.x.data[k];
    const double dy = grid.y.data[p] - queries.y.data[k];
    const double dz = grid.z.data[p] - queries.z.data[k];
    return (dx * dx + dy * dy) + dz * dz <= limit[k - run];
};
// Bit mask of the neighbors among sixteen entries of the buffer.
auto within = [&](int k, int at) -> unsigned {
    const int o = k - run;
    const v16 dx = *(const v16*)(bx + at) - (v16)(qx[o]);
    const v16 dy = *(const v16*)(by + at) - (v16)(qy[o]);
    const v16 dz = *(const v16*)(bz + at) - (v16)(qz[o]);
    const v16 d = __builtin_elementwise_fma(dx, dx, __builtin_elementwise_fma(dy, dy, dz * dz));
    unsigned inside = at_most(d, (v16)(surely[o]));
    for (unsigned doubt = 0xffff & ~(inside | above(d, (v16)(possibly[o]))); __builtin_expect(doubt != 0, 0);
         doubt &= doubt - 1) {
        const int lane = __builtin_ctz(doubt);
        inside |= (unsigned)(decides(k, place[at + lane])) << lane;
    }
    return inside;
};
auto each_run = [&](auto&& use) {
    const bool grouped = grid.groups.shape[0] > 0;
    for (run = first_query; run < last_query;) {
        if (grouped) enter(queries.group.data[run]);
        const double at[3] = {queries.x.data[run], queries.y.data[run], queries.z.data[run]};
        const int cell[3] = {cell_along(0, at[0]), cell_along(1, at[1]), cell_along(2, at[2])};
        // Float32 coordinates are relative to the first query of the run, in units of about its radius: undecided cases
        // are then rare, whatever the extent of the points. Scaling by a power of two is exact.
        const int first_row = queries.index.data[run];
        const double unit = radius.data[first_row < radius.shape[0] ? first_row : radius.shape[0] - 1];
        const double scale = unit > LEAST_UNIT && unit < LARGEST_UNIT ? inverse_power_of_two(unit) : 1.0;
        double low[3] = {at[0], at[1], at[2]}, high[3] = {at[0], at[1], at[2]}, reach = 0.0;
        int stop = run;
        for (; stop < last_query && stop - run < most_queries; ++stop) {
            const double q[3] = {queries.x.data[stop], queries.y.data[stop], queries.z.data[stop]};
            if (grouped && queries.group.data[stop] != entered) break;
            if (stop > run
                && (cell_along(0, q[0]) != cell[0] || cell_along(1, q[1]) != cell[1] || cell_along(2, q[2]) != cell[2]))
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
            // See nearness_of in neighbors_kernels.
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
            apart |= high[axis] + reach < cells.lower[axis] || low[axis] - reach > cells.upper[axis];
            from[axis] = cell_along(axis, low[axis] - reach);
            to[axis] = cell_along(axis, high[axis] + reach);
        }
        int filled = 0;
        auto flush = [&]() {
            if (filled == 0) return;
            const int padded = (filled + 15) & ~15;
            *(v16*)(bx + filled) = (v16)(__builtin_inff());
            *(i16*)(place + filled) = (i16)(-1);
            for (int k = run; k < stop; ++k) use(k, padded);
            filled = 0;
        };
        for (int z = from[2]; z <= to[2] && !apart; ++z)
            for (int y = from[1]; y <= to[1]; ++y) {
                const int64_t row = cells.base + (int64_t(z) * cells.count_y + y) * cells.count_x;
                int p = first_at_or_above(row + from[0]);
                const int row_end = first_at_or_above(row + to[0] + 1);
                while (p < row_end) {
                    const int taken = row_end - p < room - filled ? row_end - p : room - filled;
                    // Whole vectors are copied: entries beyond `taken` are padding or are overwritten.
                    for (int o = 0; o < taken; o += 16) {
                        store(bx + filled + o, grid.x.data + p + o, at[0], scale);
                        store(by + filled + o, grid.y.data + p + o, at[1], scale);
                        store(bz + filled + o, grid.z.data + p + o, at[2], scale);
                        *(i16*)(place + filled + o) = steps + (i16)(p + o);
                    }
                    filled += taken;
                    p += taken;
                    if (filled == room) flush();
                }
            }
        flush();
        run = stop;
    }
};
#endif
