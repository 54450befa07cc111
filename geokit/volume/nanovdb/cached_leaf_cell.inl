// The eight voxels of a cell that lies in one leaf of a float grid; behind it stands the block for all other cells.
//
// Expects the names of cached_accessor.inl; node and in_leaf, whether that is a leaf; x, y, z, the cell's lowest
// voxel in the leaf; c, an array of eight, which it fills, k fastest.
#if FLOAT_GRID
if (in_leaf && x < 7 && y < 7 && z < 7) {
    const address at = (node & ~1ull) + PNANOVDB_GRID_TYPE_GET(grid_type, leaf_off_table);
    const float* v = (const float*)(grid + at) + (x << 6 | y << 3 | z);
    c[0] = v[0];
    c[1] = v[1];
    c[2] = v[8];
    c[3] = v[9];
    c[4] = v[64];
    c[5] = v[65];
    c[6] = v[72];
    c[7] = v[73];
} else
#endif
