// The planes of leaves, their neighbors, and which blocks have crossed cells: see cells_kernels, and of blocks of tiles
// cells_kernels.
#include "volume/isosurface/blocks.inl"

// Writes the eight planes of a leaf: bit masks of the voxels below the limit.
static constexpr auto leaf_sides = [](int leaf, const auto& cells, float limit) {
    const float* value = (const float*)(cells.values + cells.stride * (u64)leaf);
    u64* out = cells.sides.data + 8ll * leaf;
    #if defined(__CUDA_ARCH__)
    for (int x = 0; x < 8; ++x) {
        u64 word = 0;
        for (int n = 0; n < 64; ++n) word |= (u64)(value[64 * x + n] < limit) << n;
        out[x] = word;
    }
    #else
    unsigned short* part = (unsigned short*)out;
    for (int n = 0; n < 32; ++n) {
        part[n] = __builtin_bit_cast(unsigned short, __builtin_convertvector(((const v16*)value)[n] < limit, b16));
    }
    #endif
};

// Writes a row of eight voxels of a leaf: a byte of a plane.
static constexpr auto row_sides = [](int row, const auto& cells, float limit) {
    const float* value = (const float*)(cells.values + cells.stride * (u64)(row >> 6)) + 8 * (row & 63);
    unsigned char bits = 0;
    for (int z = 0; z < 8; ++z) bits |= (unsigned char)(value[z] < limit) << z;
    ((unsigned char*)cells.sides.data)[row] = bits;
};

// The number of the lower node at a voxel, or -1 - address of the tile in its place.
static constexpr auto lower_at = [](unsigned long long volume, int grid_type, const auto& tree, int i, int j,
                                    int k) -> long long {
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_coord_t ijk = {i, j, k};
    pnanovdb_readaccessor_t accessor;
    pnanovdb_readaccessor_init(PNANOVDB_REF(accessor), wp::volume::get_root(buf));
    unsigned level;
    const pnanovdb_address_t at = pnanovdb_readaccessor_get_value_address_and_level(
        (pnanovdb_grid_type_t)grid_type, buf, PNANOVDB_REF(accessor), PNANOVDB_REF(ijk), PNANOVDB_REF(level));
    if (level <= 1u) return (long long)((accessor.lower.address.byte_offset - tree.begin) / tree.size);
    return -1ll - (long long)at.byte_offset;
};

// Whether the corners of a block's cells are not all on the same side.
static constexpr auto is_mixed = [](const auto& cells, int block) -> bool {
    const int* refs = cells.refs.data + 8ll * block;
    u64 any = 0, all = ~0ull, side[4];
    for (int x = 0; x < 8; ++x) {
        const u64 word = cells.sides.data[8ll * block + x];
        any |= word;
        all &= word;
    }
    if (any && ~all) return true;
    // All voxels of the block are on the same side, so the voxels above it decide.
    for (int x = 0; x < 9; ++x) {
        corners(cells, refs, x, inside_plane, side);
        for (int c = 0; c < 4; ++c) {
            any |= side[c];
            all &= side[c];
        }
    }
    return any && ~all;
};
static constexpr auto mark_mixed = [](int block, const auto& cells, wp::array_t<int>& out_mixed) {
    out_mixed.data[block] = is_mixed(cells, block);
};

// Finds the blocks above a leaf, the tiles below it that may have crossed cells, a bit mask by direction, and whether it
// is mixed.
static constexpr auto link_leaf = [](int leaf, const auto& cells, const auto& tree, wp::array_t<uint8_t>& out_below,
                                     wp::array_t<int>& out_some, wp::array_t<int>& out_mixed) {
    unsigned in_tiles, out_tiles;
    look_around(cells, tree, tree.leaf_lower.data[leaf], tree.leaf_slot.data[leaf], cells.refs.data + 8ll * leaf,
                in_tiles, out_tiles);
    const u64* own = cells.sides.data + 8ll * leaf;
    u64 any = 0, all = ~0ull;
    for (int x = 0; x < 8; ++x) {
        any |= own[x];
        all &= own[x];
    }
    int below = 0;
    for (int e = 1; e < 8; ++e) {
        // The leaf's voxels that the cells of the block below read.
        const u64 column = (e & 2 ? 0xffull : ~0ull) & (e & 1 ? 0x0101010101010101ull : ~0ull);
        if (is_border(in_tiles, out_tiles, e, (e & 4 ? own[0] : any) & column, ~(e & 4 ? own[0] : all) & column))
            below |= 1 << e;
    }
    out_below.data[leaf] = (uint8_t)below;
    if (below) out_some.data[0] = 1;
    out_mixed.data[leaf] = is_mixed(cells, leaf);
};

// The number of a leaf, from its node as node_of returns it.
static constexpr auto leaf_at = [](const auto& cells, const auto& tree, unsigned long long node) -> int {
    return leaf_index(cells, tree, node & ~1ull);
};

// Which of eight tiles may have crossed cells, an active one and its neighbors towards lower indices: a bit mask by
// direction.
static constexpr auto mark_tile_border = [](int tile, const auto& cells, const auto& tree,
                                            const wp::array_t<int>& lower, const wp::array_t<int>& slot,
                                            wp::array_t<uint8_t>& out_below) {
    unsigned in_tiles, out_tiles;
    look_around(cells, tree, lower.data[tile], slot.data[tile], (int*)0, in_tiles, out_tiles);
    int below = 0;
    for (int e = 0; e < 8; ++e)
        if (is_border(in_tiles, out_tiles, e, false, false)) below |= 1 << e;
    out_below.data[tile] = (uint8_t)below;
};

// Binary search for the border block that starts at the voxel (i, j, k), -1 for none. Border blocks are sorted by x,
// then y, then z.
static constexpr auto find_border_block = [](const auto& cells, int border_count, int i, int j, int k) -> int {
    const wp::vec3i* blocks = cells.origin.data + cells.leaf_count;
    int low = 0, high = border_count;
    while (low < high) {
        const int middle = (low + high) / 2;
        const wp::vec3i& r = blocks[middle];
        const bool before = r[0] != i ? r[0] < i : r[1] != j ? r[1] < j : r[2] < k;
        if (before) low = middle + 1;
        else high = middle;
    }
    const bool found = low < border_count && blocks[low][0] == i && blocks[low][1] == j && blocks[low][2] == k;
    return found ? cells.leaf_count + low : -1;
};
