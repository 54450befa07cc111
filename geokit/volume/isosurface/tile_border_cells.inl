// Blocks of tiles with crossed cells: see tile_border_cells_kernels.
#include "volume/isosurface/blocks.inl"

// Which of eight tiles may have crossed cells, an active one and its neighbors towards lower indices: a bit mask by
// direction.
static constexpr auto tile_border = [](const Cells& cells, const auto& tree, int lower, int slot) -> int {
    unsigned in_tiles, out_tiles;
    look_around(cells, tree, lower, slot, (int*)0, in_tiles, out_tiles);
    int below = 0;
    for (int e = 0; e < 8; ++e)
        if (is_border(in_tiles, out_tiles, e, false, false)) below |= 1 << e;
    return below;
};

// Binary search for the border block that starts at the voxel (i, j, k), -1 for none. Border blocks are sorted by x,
// then y, then z.
static constexpr auto find_border_block = [](const Cells& cells, int border_count, int i, int j, int k) -> int {
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
