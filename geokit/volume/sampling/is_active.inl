// Whether a voxel, or the tile that covers it, is active. Warp has no built-in for this. PNanoVDB, which warp compiles
// into its kernels, reads the value masks of leaves and tiles and the state of the root's tiles.
static constexpr auto is_active = [](unsigned long long volume, int i, int j, int k) -> bool {
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_coord_t ijk = {i, j, k};
    pnanovdb_readaccessor_t accessor;
    pnanovdb_readaccessor_init(PNANOVDB_REF(accessor), wp::volume::get_root(buf));
    return pnanovdb_readaccessor_is_active(wp::volume::get_grid_type(buf), buf, PNANOVDB_REF(accessor),
                                           PNANOVDB_REF(ijk))
           != PNANOVDB_FALSE;
};
