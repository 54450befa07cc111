// The voxels (i, j, k) to (i + 1, j + 1, k + 1) of a float grid, all of them in one leaf.
//
// Expects volume, node (address of the leaf, its lowest bit may be set), i, j, k. Returns eight doubles, k fastest.
const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
const pnanovdb_leaf_handle_t leaf = {node & ~1ull};
const pnanovdb_coord_t ijk = {i, j, k};
const unsigned n = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk));
wp::vec_t<8, double> result;
for (unsigned c = 0u; c < 8u; ++c) {
    const unsigned step = ((c & 4u) << 4) + ((c & 2u) << 2) + (c & 1u);
    result[c] = (double)pnanovdb_read_float(
        buf, pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_FLOAT, buf, leaf, n + step));
}
return result;
