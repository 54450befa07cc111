// Whether the corners of a block's cells are not all on the same side.
//
// Expects block_planes.inl, cells, block. Returns the answer.

const int* refs = cells.refs.data + 8ll * block;
u64 any = 0, all = ~0ull, side[4];
for (int x = 0; x < 8; ++x) {
    const u64 word = cells.sides.data[8ll * block + x];
    any |= word;
    all &= word;
}
if (any && ~all) return true;
// All voxels of the block are on the same side, so the voxels above it decide.
for (int x = 7; x < 9; ++x) {
    corners(refs, x, inside_plane, side);
    for (int c = 0; c < 4; ++c) {
        any |= side[c];
        all &= side[c];
    }
}
for (int x = 0; x < 7; ++x) {
    corners(refs, x, inside_plane, side);
    for (int c = 0; c < 4; ++c) {
        any |= side[c];
        all &= side[c];
    }
}
return any && ~all;
