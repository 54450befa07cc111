// The fourth numbers and the distances of the candidates of one list that are within the limit, from `to` on.
//
// Expects verlet_row.inl, PREFETCHED, next, soon, to, out_index, out_distance. `next` is where a row begins that is
// written soon, and `soon` its length.

#if defined(__CUDA_ARCH__)
each([&](double d, double w) {
    out_index.data[to] = (int)w;
    out_distance.data[to++] = sqrt(d);
});
#else
// Rows are in the caller's order, scattered over memory: all lines of one that is written soon are prefetched.
auto prefetch = [&](const auto* first) {
    const char* const last = (const char*)(first + (soon < PREFETCHED ? soon : PREFETCHED)) + 63;
    for (const char* line = (const char*)(first); line < last; line += 64) __builtin_prefetch(line, 1);
};
prefetch(out_index.data + next);
prefetch(out_distance.data + next);
constexpr int room = 256;
alignas(64) double square[room + 8], named[room + 8];
int filled = 0;
int at_row = to;
auto flush = [&]() {
    for (int i = 0; i < filled; i += 8) { *(d8*)(square + i) = __builtin_elementwise_sqrt(*(const d8*)(square + i)); }
    for (int i = 0; i < filled; ++i) {
        out_index.data[at_row + i] = (int)(named[i]);
        out_distance.data[at_row + i] = square[i];
    }
    at_row += filled;
    filled = 0;
};
each([&](unsigned mask, d8 d, d8 w) {
    if (filled > room - 8) flush();
#if defined(__AVX512F__)
    // Packed in a register and stored whole: see radius_keep_cpu.inl.
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
