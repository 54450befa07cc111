// Bit masks of planes of 64 cells: which of their corners are inside and which are active.
//
// Expects cells; on a CPU also core/simd.inl. Defines u64, count_bits, first_bit, inside_plane, active_plane, corners
// and case_of.

// A leaf's mask of active voxels follows its box and flags, whatever the type.
constexpr int LEAF_MASK = 16;
// Population count and lowest set bit of a word, with the device's own instructions.
typedef unsigned long long u64;
#ifdef __CUDA_ARCH__
auto count_bits = [](u64 w) { return __popcll(w); };
auto first_bit = [](u64 w) { return __ffsll((long long)w) - 1; };
#else
auto count_bits = [](u64 w) { return __builtin_popcountll(w); };
auto first_bit = [](u64 w) { return __builtin_ctzll(w); };
#endif
// Plane x of the voxels of a block or tile: which are inside.
auto inside_plane = [&](int ref, int x) -> u64 {
    if (ref >= 0) return cells.sides.data[8ll * ref + x];
    return (-1 - ref) & 1 ? ~0ull : 0ull;
};
auto active_plane = [&](int ref, int x) -> u64 {
    if (ref < 0) return (-1 - ref) & 2 ? ~0ull : 0ull;
    if (ref >= cells.leaf_count) return cells.border_active.data[ref - cells.leaf_count] ? ~0ull : 0ull;
    return *(const u64*)(cells.volume + cells.leaf_offset.data[ref] + LEAF_MASK + 8 * x);
};
// Bit masks of the voxels (x, y, z), (x, y, z + 1), (x, y + 1, z) and (x, y + 1, z + 1) of the 64 cells of plane x; x
// may be 8.
auto corners = [&](const int* refs, int x, auto plane, u64* out) {
    const int* column = refs + (x == 8 ? 4 : 0);
    x &= 7;
    const u64 own = plane(column[0], x), above = plane(column[1], x);
    const u64 beside = (own >> 8) | (plane(column[2], x) << 56);
    const u64 both = (above >> 8) | (plane(column[3], x) << 56);
    const u64 inner = 0x7f7f7f7f7f7f7f7full;
    out[0] = own;
    out[1] = ((own >> 1) & inner) | ((above << 7) & ~inner);
    out[2] = beside;
    out[3] = ((beside >> 1) & inner) | ((both << 7) & ~inner);
};
// Bit mask of the inside corners of one cell.
auto case_of = [&](const u64* inside, int bit) -> int {
    #ifdef __CUDA_ARCH__
    int code = 0;
    for (int c = 0; c < 8; ++c) code |= (int)(inside[c] >> bit & 1u) << c;
    return code;
    #else
    typedef u64 w8 __attribute__((ext_vector_type(8), aligned(8)));
    const w8 chosen = *(const w8*)inside & (1ull << bit);
    return (int)mask_of(chosen != 0ull);
    #endif
};
