// Compresses the entries of the buffer whose bits are set.
//
// Expects radius_runs_cpu.inl. Defines keep(to, at, inside): writes the positions of those of the sixteen entries from
// `at` on whose bit in `inside` is set, and returns their number; sixteen entries of `to` may be overwritten.

#if !defined(__CUDA_ARCH__)
typedef int stored __attribute__((__vector_size__(64)));
auto keep = [&](int* to, int at, unsigned inside) -> int {
#if defined(__AVX512F__)
    __builtin_ia32_compressstoresi512_mask((stored*)to, *(const stored*)(place + at), inside);
    return __builtin_popcount(inside);
#else
    int kept = 0;
    for (; inside; inside &= inside - 1) to[kept++] = place[at + __builtin_ctz(inside)];
    return kept;
#endif
};
#endif
