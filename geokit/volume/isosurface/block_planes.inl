// Bit masks of planes of 64 cells: which of their corners are inside and which are active.
#pragma once
#include "core/simd.inl"

// A leaf's mask of active voxels follows its box and flags, whatever the type.
constexpr int LEAF_MASK = 16;
// Population count and lowest set bit of a word, with the device's own instructions.
typedef unsigned long long u64;
#ifdef __CUDA_ARCH__
static constexpr auto count_bits = [](u64 w) { return __popcll(w); };
static constexpr auto first_bit = [](u64 w) { return __ffsll((long long)w) - 1; };
#else
static constexpr auto count_bits = [](u64 w) { return __builtin_popcountll(w); };
static constexpr auto first_bit = [](u64 w) { return __builtin_ctzll(w); };
#endif
// Plane x of the voxels of a block or tile: which are inside.
static constexpr auto inside_plane = [](const auto& cells, int ref, int x) -> u64 {
    if (ref >= 0) return cells.sides.data[8ll * ref + x];
    return (-1 - ref) & 1 ? ~0ull : 0ull;
};
static constexpr auto active_plane = [](const auto& cells, int ref, int x) -> u64 {
    if (ref < 0) return (-1 - ref) & 2 ? ~0ull : 0ull;
    if (ref >= cells.leaf_count) return cells.border_active.data[ref - cells.leaf_count] ? ~0ull : 0ull;
    return *(const u64*)(cells.volume + cells.leaf_offset.data[ref] + LEAF_MASK + 8 * x);
};
// Bit masks of the voxels (x, y, z), (x, y, z + 1), (x, y + 1, z) and (x, y + 1, z + 1) of the 64 cells of plane x; x
// may be 8.
static constexpr auto corners = [](const auto& cells, const int* refs, int x, auto plane, u64* out) {
    const int* column = refs + (x == 8 ? 4 : 0);
    x &= 7;
    const u64 own = plane(cells, column[0], x), above = plane(cells, column[1], x);
    const u64 beside = (own >> 8) | (plane(cells, column[2], x) << 56);
    const u64 both = (above >> 8) | (plane(cells, column[3], x) << 56);
    const u64 inner = 0x7f7f7f7f7f7f7f7full;
    out[0] = own;
    out[1] = ((own >> 1) & inner) | ((above << 7) & ~inner);
    out[2] = beside;
    out[3] = ((beside >> 1) & inner) | ((both << 7) & ~inner);
};
// The voxels of plane x of a block's cells.
static constexpr auto cell_corners = [](const auto& cells, int block, int x, auto which, u64* out) {
    corners(cells, cells.refs.data + 8ll * block, x, which, out);
    corners(cells, cells.refs.data + 8ll * block, x + 1, which, out + 4);
};
// The cells of a plane with a crossed edge without an active end, from their inside and their active corners.
static constexpr auto dead_edges = [](const u64* c, const u64* a) {
    u64 dead = 0;
    for (int step = 4; step; step >>= 1)
        for (int n = 0; n < 8; ++n)
            if (!(n & step)) dead |= (c[n] ^ c[n + step]) & ~(a[n] | a[n + step]);
    return dead;
};
// Bit mask of the inside corners of one cell.
static constexpr auto case_of = [](const u64* inside, int bit) -> int {
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
