// Where the value of a voxel is stored.
//
// Expects volume, grid_type, i, j, k. Returns the address of the leaf, marked by its lowest bit, which no address
// has; or of the value of the tile or background.
const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
const pnanovdb_coord_t ijk = {i, j, k};
pnanovdb_readaccessor_t accessor;
pnanovdb_readaccessor_init(PNANOVDB_REF(accessor), wp::volume::get_root(buf));
unsigned level;
const pnanovdb_address_t at = pnanovdb_readaccessor_get_value_address_and_level(
    (pnanovdb_grid_type_t)grid_type, buf, PNANOVDB_REF(accessor), PNANOVDB_REF(ijk), PNANOVDB_REF(level));
return level == 0u ? accessor.leaf.address.byte_offset | 1u : at.byte_offset;
