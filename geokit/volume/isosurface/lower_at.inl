// The number of the lower node at a voxel, or -1 - address of the tile in its place.
//
// Expects volume, grid_type, tree, i, j, k. Returns the long long.

const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
const pnanovdb_coord_t ijk = {i, j, k};
pnanovdb_readaccessor_t accessor;
pnanovdb_readaccessor_init(PNANOVDB_REF(accessor), wp::volume::get_root(buf));
unsigned level;
const pnanovdb_address_t at = pnanovdb_readaccessor_get_value_address_and_level(
    (pnanovdb_grid_type_t)grid_type, buf, PNANOVDB_REF(accessor), PNANOVDB_REF(ijk), PNANOVDB_REF(level));
if (level <= 1u) return (long long)((accessor.lower.address.byte_offset - tree.begin) / tree.size);
return -1ll - (long long)at.byte_offset;
