// The tree level that holds the value of a voxel: 0 leaf, 1 lower node, 2 upper node, 3 and more the
// root.
//
// Expects volume, i, j, k. Returns the int.
const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
const pnanovdb_coord_t ijk = {i, j, k};
pnanovdb_readaccessor_t accessor;
pnanovdb_readaccessor_init(PNANOVDB_REF(accessor), wp::volume::get_root(buf));
unsigned level;
pnanovdb_readaccessor_get_value_address_and_level((pnanovdb_grid_type_t)wp::volume::get_grid_type(buf), buf,
                                                  PNANOVDB_REF(accessor), PNANOVDB_REF(ijk), PNANOVDB_REF(level));
return (int)level;
