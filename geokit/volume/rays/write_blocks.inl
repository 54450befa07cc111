// Writes the cells that may hold a crossing, and the nodes, of each busy block of a row along z; and for all other
// blocks a start value of the distance to the next busy block. A cell's bit is 0 under the condition that
// mark_blocks.inl has for blocks.
//
// Expects row, volume, anchor, first_block and block_count (see crossing_blocks_kernels), below and above; the macro
// FLOAT_GRID; numbers, out_distance, out_blocks; the constants FARTHEST and BLOCK_WORDS.
#include "volume/nanovdb/cached_accessor.inl"
(void)background;
const int row_x = row / block_count[1], row_y = row % block_count[1];
const bool is_border = row_x == 0 || row_y == 0 || row_x == block_count[0] - 1 || row_y == block_count[1] - 1;
const int x = 8 * (first_block[0] + row_x), y = 8 * (first_block[1] + row_y);
for (int n = 0; n < block_count[2]; ++n) {
    const address at = (address)row * block_count[2] + n;
    const int own = numbers.data[at];
    if (numbers.data[at + 1] == own) {
        out_distance.data[at] = is_border || n == 0 || n == block_count[2] - 1 ? -1 : FARTHEST;
        continue;
    }
    out_distance.data[at] = 0;
    const int z = 8 * (first_block[2] + n);
    unsigned long long* block = (unsigned long long*)out_blocks.data + BLOCK_WORDS * (address)own;
    for (int m = 0; m < 8; ++m) block[8 + m] = find(x + 2 * (m & 4), y + 4 * (m & 2), z + 8 * (m & 1), ignored);
    // Two layers of nine lines; bit k of a line is its voxel k along z.
    unsigned over[2][9], under[2][9];
    for (int i = 0; i < 9; ++i) {
        for (int j = 0; j < 9; ++j) {
            unsigned o = 0, u = 0;
            const address* nodes = (const address*)block + 8 + (i >> 3 << 2 | j >> 3 << 1);
            for (int k = 0; k < 8; ++k) {
                const real v = voxel(nodes[0], x + i, y + j, z + k);
                o |= (v > (real)below ? 1u : 0u) << k;
                u |= (v < (real)above ? 1u : 0u) << k;
            }
            const real v = voxel(nodes[1], x + i, y + j, z + 8);
            over[i & 1][j] = o | (v > (real)below ? 1u : 0u) << 8;
            under[i & 1][j] = u | (v < (real)above ? 1u : 0u) << 8;
        }
        if (i == 0) continue;
        unsigned long long cells = 0;
        for (int j = 0; j < 8; ++j) {
            const unsigned o = over[0][j] & over[0][j + 1] & over[1][j] & over[1][j + 1];
            const unsigned u = under[0][j] & under[0][j + 1] & under[1][j] & under[1][j + 1];
            cells |= (unsigned long long)(~(o & o >> 1 | u & u >> 1) & 255u) << 8 * j;
        }
        block[i - 1] = cells;
    }
}
