// Candidates of one Verlet list that are within the limit. In C++, because warp has no vectors of eight doubles.
#include "core/simd.inl"

// Squared distances of the candidates from the point at `place`: on a CPU use(mask, d, w) is called for eight of them,
// with a bit for each that is within the limit and not at place `own`, the squared distances and the fourth numbers; on
// a GPU use(d, w) is called for each candidate that is.
//
// Both branches round alike, lane by lane.
static constexpr auto each_near = [](const wp::array_t<wp::vec4d>& at, const wp::array_t<int>& near, int begin, int end,
                                     int place, int own, double limit, auto&& use) {
    const double* const rows = (const double*)at.data;
    const double* const q = rows + 4 * (int64_t)place;
#if defined(__CUDA_ARCH__)
    for (int c = begin; c < end; ++c) {
        const int p = near.data[c];
        const double2* const row = (const double2*)(rows + 4 * (int64_t)p);
        const double2 low = row[0], high = row[1];
        const double dx = low.x - q[0], dy = low.y - q[1], dz = high.x - q[2];
        const double d = (dx * dx + dy * dy) + dz * dz;
        if (d <= limit && p != own) use(d, high.y);
    }
#else
    const d8 qx = (d8)(q[0]), qy = (d8)(q[1]), qz = (d8)(q[2]);
    auto two = [&](int p, int o) -> d8 {
        const d4 low = *(const d4*)(rows + 4 * (int64_t)p), high = *(const d4*)(rows + 4 * (int64_t)o);
        return __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7);
    };
    for (int c = begin; c < end; c += 8) {
        // The list is padded by eight places.
        const int* const p = near.data + c;
        const d8 a = two(p[0], p[4]), b = two(p[1], p[5]), e = two(p[2], p[6]), f = two(p[3], p[7]);
        const d8 xz = __builtin_shufflevector(a, b, 0, 8, 2, 10, 4, 12, 6, 14);
        const d8 yw = __builtin_shufflevector(a, b, 1, 9, 3, 11, 5, 13, 7, 15);
        const d8 xz_next = __builtin_shufflevector(e, f, 0, 8, 2, 10, 4, 12, 6, 14);
        const d8 yw_next = __builtin_shufflevector(e, f, 1, 9, 3, 11, 5, 13, 7, 15);
        const d8 dx = __builtin_shufflevector(xz, xz_next, 0, 1, 8, 9, 4, 5, 12, 13) - qx;
        const d8 dy = __builtin_shufflevector(yw, yw_next, 0, 1, 8, 9, 4, 5, 12, 13) - qy;
        const d8 dz = __builtin_shufflevector(xz, xz_next, 2, 3, 10, 11, 6, 7, 14, 15) - qz;
        const d8 w = __builtin_shufflevector(yw, yw_next, 2, 3, 10, 11, 6, 7, 14, 15);
        const d8 d = (dx * dx + dy * dy) + dz * dz;
        unsigned mask = mask_of(d <= (d8)(limit)) & ~mask_of(*(const i8*)(p) == (i8)(own));
        if (end - c < 8) mask &= (1u << (end - c)) - 1u;
        use(mask, d, w);
    }
#endif
};

// Their number.
static constexpr auto near_count = [](const wp::array_t<wp::vec4d>& at, const wp::array_t<int>& near, int begin,
                                      int end, int place, int own, double limit) -> int {
    int inside = 0;
#if defined(__CUDA_ARCH__)
    each_near(at, near, begin, end, place, own, limit, [&](double, double) { ++inside; });
#else
    each_near(at, near, begin, end, place, own, limit,
              [&](unsigned mask, d8, d8) { inside += __builtin_popcount(mask); });
#endif
    return inside;
};

// Their fourth numbers and distances, from `to` on. `next` is where a row begins that is written soon, and `soon` its
// length.
static constexpr auto near_fill = [](const wp::array_t<wp::vec4d>& at, const wp::array_t<int>& near, int begin, int end,
                                     int place, int own, double limit, int64_t next, int64_t soon, int to,
                                     wp::array_t<int>& out_index, auto& out_distance) {
#if defined(__CUDA_ARCH__)
    each_near(at, near, begin, end, place, own, limit, [&](double d, double w) {
        out_index.data[to] = (int)w;
        out_distance.data[to++] = sqrt(d);
    });
#else
    // Rows are in the caller's order, scattered over memory: all lines of one that is written soon are prefetched, of a
    // long one the first 64 entries.
    auto prefetch = [&](const auto* first) {
        const char* const last = (const char*)(first + (soon < 64 ? soon : 64)) + 63;
        for (const char* line = (const char*)(first); line < last; line += 64) __builtin_prefetch(line, 1);
    };
    prefetch(out_index.data + next);
    prefetch(out_distance.data + next);
    constexpr int room = 256;
    alignas(64) double square[room + 8], named[room + 8];
    int filled = 0;
    auto flush = [&]() {
        for (int i = 0; i < filled; i += 8) *(d8*)(square + i) = __builtin_elementwise_sqrt(*(const d8*)(square + i));
        for (int i = 0; i < filled; ++i) {
            out_index.data[to + i] = (int)(named[i]);
            out_distance.data[to + i] = square[i];
        }
        to += filled;
        filled = 0;
    };
    each_near(at, near, begin, end, place, own, limit, [&](unsigned mask, d8 d, d8 w) {
        if (filled > room - 8) flush();
#if defined(__AVX512F__)
        // Packed in a register and stored whole: see keep in radius_cpu.inl.
        typedef double packed __attribute__((__vector_size__(64)));
        *(d8*)(square + filled) = (d8)(__builtin_ia32_compressdf512_mask((packed)(d), packed{}, mask));
        *(d8*)(named + filled) = (d8)(__builtin_ia32_compressdf512_mask((packed)(w), packed{}, mask));
        filled += __builtin_popcount(mask);
#else
        for (; mask; mask &= mask - 1) {
            const int lane = __builtin_ctz(mask);
            square[filled] = d[lane];
            named[filled++] = w[lane];
        }
#endif
    });
    flush();
#endif
};
