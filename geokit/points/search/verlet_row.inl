// Squared distances of the candidates of one list, eight at a time on a CPU.
//
// Expects core/simd.inl, at, near, begin, end, place, own, limit. Defines each(use): on a CPU use(mask, d, w) is called
// for eight candidates, with a bit for each that is within the limit and not at place `own`, the squared distances and
// the fourth numbers; on a GPU use(d, w) is called for each candidate that is.
//
// In C++, because warp has no vectors of eight doubles. Both branches round alike, lane by lane.

const double* const rows = (const double*)at.data;
const double* const q = rows + 4 * (int64_t)place;
#if defined(__CUDA_ARCH__)
auto each = [&](auto&& use) {
    for (int c = begin; c < end; ++c) {
        const int p = near.data[c];
        const double2* const row = (const double2*)(rows + 4 * (int64_t)p);
        const double2 low = row[0], high = row[1];
        const double dx = low.x - q[0], dy = low.y - q[1], dz = high.x - q[2];
        const double d = (dx * dx + dy * dy) + dz * dz;
        if (d <= limit && p != own) use(d, high.y);
    }
};
#else
auto each = [&](auto&& use) {
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
};
#endif
