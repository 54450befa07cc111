// The sheets of the surface in a cell.
//
// Expects block_planes.inl, cells, table, flips. Defines word_of, loop_count and cell_corners.
//
// `table` is loop_table: a word for each case, and one for each case with its problem face joined. A word has two bits
// for the loop of each edge, the number of loops, and the problem face + 1.

auto word_of = [&](int code, int plane, int bit) -> unsigned {
    return table.data[code + (int)(flips.data[plane] >> bit & 1ull) * 256];
};
auto loop_count = [](unsigned word) { return (int)(word >> 24 & 7u); };
// The voxels of plane x of a block's cells.
auto cell_corners = [&](int block, int x, auto which, u64* out) {
    corners(cells.refs.data + 8ll * block, x, which, out);
    corners(cells.refs.data + 8ll * block, x + 1, which, out + 4);
};
