// Marks the blocks of a row along z that may hold a crossing. The cells of a block read the voxels of the block and
// the first layer of the seven blocks above it. A block holds no crossing only if all of these are on the same side
// of the isovalue; NaN and the isovalue itself are on neither side.
//
// Expects row, volume, anchor, first_block and block_count (see crossing_blocks_kernels), below and above; the macro
// FLOAT_GRID; out_busy.
#include "volume/nanovdb/cached_accessor.inl"
(void)background;
auto look = [&](address node, int x, int y, int z, int nx, int ny, int nz, bool& over, bool& under) {
    for (int i = 0; i < nx && (over || under); ++i)
        for (int j = 0; j < ny; ++j)
            for (int k = 0; k < nz; ++k) {
                const real v = voxel(node, x + i, y + j, z + k);
                over = over & (v > (real)below);
                under = under & (v < (real)above);
            }
};
const int row_x = row / block_count[1], row_y = row % block_count[1];
const bool is_border = row_x == 0 || row_y == 0 || row_x == block_count[0] - 1 || row_y == block_count[1] - 1;
const int x = 8 * (first_block[0] + row_x), y = 8 * (first_block[1] + row_y);
int* out = out_busy.data + (address)row * block_count[2];
// The prefix sum that follows has one element more than there are blocks.
if (row == 0) out_busy.data[(address)block_count[0] * block_count[1] * block_count[2]] = 0;
for (int n = 0; n < block_count[2]; ++n) {
    const int z = 8 * (first_block[2] + n);
    bool over = true, under = true;
    for (int m = 0; m < 8 && (over || under) && !is_border && n > 0 && n < block_count[2] - 1; ++m) {
        const int i = x + 2 * (m & 4), j = y + 4 * (m & 2), k = z + 8 * (m & 1);
        const address node = find(i, j, k, ignored);
        if (!(node & 1)) look(node, i, j, k, 1, 1, 1, over, under);
        else if (m == 0) look(node, i, j, k, 8, 8, 8, over, under);
        else look(node, i, j, k, m & 4 ? 1 : 8, m & 2 ? 1 : 8, m & 1 ? 1 : 8, over, under);
    }
    out[n] = over || under ? 0 : 1;
}
