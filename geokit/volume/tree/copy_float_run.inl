// Copies voxels along z of a float grid, all of them in one leaf or tile.
//
// Expects volume, node (of node_of, for the first voxel), i, j, k, count, out_values, to.

const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
const pnanovdb_address_t at = {node & ~1ull};
const pnanovdb_leaf_handle_t leaf = {at};
const pnanovdb_coord_t ijk = {i, j, k};
float* target = out_values.data + to;
if ((node & 1u) == 0u) {
    const float value = pnanovdb_read_float(buf, at);
    for (int n = 0; n < count; ++n) target[n] = value;
    return;
}
const unsigned first_voxel = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk));
for (int n = 0; n < count; ++n) {
    target[n] = pnanovdb_read_float(
        buf, pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_FLOAT, buf, leaf, first_voxel + (unsigned)n));
}
