// Voxels of float and int64 grids along z: see dense_rows_kernels.

// Copies voxels along z of a float grid, all of them in one leaf or tile, whose node is that of node_of for the first.
static constexpr auto copy_float_run = [](unsigned long long volume, unsigned long long node, int i, int j, int k,
                                          int count, wp::array_t<float>& out_values, long long to) {
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
};

// The value of a voxel of an int64 grid, whose node is that of node_of.
static constexpr auto read_int64 = [](unsigned long long volume, unsigned long long node, int i, int j,
                                      int k) -> long long {
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_address_t at = {node & ~1ull};
    const pnanovdb_leaf_handle_t leaf = {at};
    const pnanovdb_coord_t ijk = {i, j, k};
    const unsigned n = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk));
    if ((node & 1u) == 0u) return pnanovdb_read_int64(buf, at);
    return pnanovdb_read_int64(buf, pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_INT64, buf, leaf, n));
};
