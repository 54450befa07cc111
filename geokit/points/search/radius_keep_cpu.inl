// Compresses the entries of the buffer whose bits are set.
//
// Expects radius_runs_cpu.inl. Defines keep(to, at, inside): writes the positions of those of the sixteen entries from
// `at` on whose bit in `inside` is set, and returns their number; sixteen entries of `to` may be overwritten.

#if !defined(__CUDA_ARCH__)
typedef int stored __attribute__((__vector_size__(64)));
auto keep = [&](int* to, int at, unsigned inside) -> int {
#if defined(__AVX512F__)
    // Packed in a register and stored whole: on AMD's Zen 4 a store that packs takes some hundred cycles.
    *(i16*)(to) = (i16)(__builtin_ia32_compresssi512_mask(*(const stored*)(place + at), stored{}, inside));
    return __builtin_popcount(inside);
#else
    int kept = 0;
    for (; inside; inside &= inside - 1) to[kept++] = place[at + __builtin_ctz(inside)];
    return kept;
#endif
};
#endif
