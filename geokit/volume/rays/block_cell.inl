// Visits the cell (x, y, z) of a block, which may hold a crossing, from ta to the next border.
//
// Expects the names of traverse_blocks.inl; lx, ly, lz, the block's first cell; next, the ray parameter of the border.
bx = lx + x;
by = ly + y;
bz = lz + z;
tb = next < last ? next : last;
const bool mixed = true;
const address node = nodes[0];
const bool in_leaf = node & 1;
real c[8];
#include "volume/nanovdb/cached_leaf_cell.inl"
{
    for (int m = 0; m < 8; ++m) {
        const int i = x + (m >> 2), j = y + (m >> 1 & 1), k = z + (m & 1);
        c[m] = voxel(nodes[i >> 3 << 2 | j >> 3 << 1 | k >> 3], lx + i, ly + j, lz + k);
    }
}
#include ON_CELL
unseen = -1;
