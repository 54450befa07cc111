// The 27 blocks around a block: leaf numbers, or tiles as negative numbers.
#pragma once
#include "volume/isosurface/block_planes.inl"

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
