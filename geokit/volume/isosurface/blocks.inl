// Bit masks of planes of 64 cells: which of their corners are inside and which are active. Then the 27 blocks around a
// block: leaf numbers, or tiles as negative numbers.
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

// The number of a leaf, from its byte offset from the grid's start.
static constexpr auto leaf_index = [](const auto& cells, const auto& tree, unsigned long long offset) -> int {
    if (tree.leaf_size) return (int)((unsigned)((offset - tree.leaf_begin) >> 5) / (unsigned)(tree.leaf_size >> 5));
    int low = 0, high = cells.leaf_count - 1;
    while (low < high) {
        const int middle = (low + high) / 2;
        if (cells.leaf_offset.data[middle] < offset) low = middle + 1;
        else high = middle;
    }
    return low;
};

// Offsets of a lower node's masks: active tiles after its box and flags, then children.
constexpr int LOWER_MASK = 32, LOWER_CHILDREN = 544;

// Bit masks of the blocks around the one in a slot of a lower node: tiles inside and tiles outside. Block (dx, dy, dz)
// is bit 13 + 9 dx + 3 dy + dz. Writes the eight blocks above if refs is not null.
static constexpr auto look_around = [](const auto& cells, const auto& tree, int lower, int slot, int* refs,
                                       unsigned& in_tiles, unsigned& out_tiles) {
    in_tiles = out_tiles = 0u;
    const int place[3] = {slot >> 8, slot >> 4 & 15, slot & 15};
    for (int dx = -1, number = 0; dx <= 1; ++dx)
        for (int dy = -1; dy <= 1; ++dy)
            for (int dz = -1; dz <= 1; ++dz, ++number) {
                const int x = place[0] + dx, y = place[1] + dy, z = place[2] + dz;
                const int node =
                    tree.around.data[27ll * lower + 9 * ((x >> 4) + 1) + 3 * ((y >> 4) + 1) + (z >> 4) + 1];
                const int at = (x & 15) << 8 | (y & 15) << 4 | (z & 15);
                const bool above = refs && dx >= 0 && dy >= 0 && dz >= 0;
                int ref = node;
                if (node >= 0) {
                    const u64 start = tree.begin + tree.size * (u64)node;
                    const u64 bytes = cells.volume + start;
                    if (((const unsigned char*)bytes)[LOWER_CHILDREN + (at >> 3)] >> (at & 7) & 1) {
                        ref = above ? leaf_index(cells, tree, start + *(const u64*)(bytes + tree.table + 8 * at)) : 0;
                    } else {
                        const int inside = (int)(tree.tile_inside.data[64ll * node + (at >> 6)] >> (at & 63) & 1u);
                        const int active = ((const unsigned char*)bytes)[LOWER_MASK + (at >> 3)] >> (at & 7) & 1;
                        ref = -1 - (inside | active << 1);
                    }
                }
                if (ref < 0) ((-1 - ref) & 1 ? in_tiles : out_tiles) |= 1u << number;
                if (above) refs[4 * dx + 2 * dy + dz] = ref;
            }
};

// Whether the block 13 - 9 ex - 3 ey - ez is a tile that may have crossed cells. Two corners of a crossed cell differ.
// So among the 8 blocks that it may reach, tiles differ from each other or from voxels of a leaf. Each leaf tests its
// own voxels only.
static constexpr auto is_border = [](unsigned in_tiles, unsigned out_tiles, int e, bool some_in,
                                     bool some_out) -> bool {
    const int block = 13 - 9 * (e >> 2) - 3 * (e >> 1 & 1) - (e & 1);
    // The block itself and the seven above it.
    const unsigned reached = 0x361bu << block;
    return ((in_tiles | out_tiles) >> block & 1u) && (some_in || in_tiles & reached)
           && (some_out || out_tiles & reached);
};
