// The value of a voxel of an int64 grid.
//
// Expects volume, node (of node_of, for this voxel), i, j, k. Returns the value.

const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
const pnanovdb_address_t at = {node & ~1ull};
const pnanovdb_leaf_handle_t leaf = {at};
const pnanovdb_coord_t ijk = {i, j, k};
const unsigned n = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk));
if ((node & 1u) == 0u) return pnanovdb_read_int64(buf, at);
return pnanovdb_read_int64(buf, pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_INT64, buf, leaf, n));
