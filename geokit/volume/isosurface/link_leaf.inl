// Finds the blocks above a leaf, and the tiles below it that may have crossed cells.
//
// Expects blocks_around.inl, cells, leaf. Returns the tiles as a bit mask by direction.

look_around(cells.refs.data + 8ll * leaf);
const u64* own = cells.sides.data + 8ll * leaf;
u64 any = 0, all = ~0ull;
for (int x = 0; x < 8; ++x) {
    any |= own[x];
    all &= own[x];
}
int below = 0;
for (int e = 1; e < 8; ++e) {
    // The leaf's voxels that the cells of the block below read.
    const u64 column = (e & 2 ? 0xffull : ~0ull) & (e & 1 ? 0x0101010101010101ull : ~0ull);
    if (is_border(e, (e & 4 ? own[0] : any) & column, ~(e & 4 ? own[0] : all) & column)) below |= 1 << e;
}
return below;
