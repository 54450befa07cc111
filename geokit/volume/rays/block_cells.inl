// Steps from cell to cell of a block, with a branch on the axis of the next border.
//
// Expects the names of traverse_blocks.inl.
const int lx = bx & ~7, ly = by & ~7, lz = bz & ~7;
int x = bx - lx, y = by - ly, z = bz - lz;
double tx = ((double)(bx + fx) - qx) * ix, ty = ((double)(by + fy) - qy) * iy, tz = ((double)(bz + fz) - qz) * iz;
do {
    along_x = tx <= ty && tx <= tz;
    along_y = !along_x && ty <= tz;
    const double t = along_x ? tx : along_y ? ty : tz;
    const double next = t > ta ? t : ta;
    if (block[x] >> (y << 3 | z) & 1) {
        // The ray ends in this block, before this cell.
        if (!(ta <= last)) break;
#include "volume/rays/block_cell.inl"
    } else {
        unseen = along_x ? 4 * (1 - fx) : along_y ? 2 * (1 - fy) : 1 - fz;
        ON_UNSEEN
    }
    ta = next;
    if (along_x) {
        x += sx;
        tx = ((double)(lx + x + fx) - qx) * ix;
    } else if (along_y) {
        y += sy;
        ty = ((double)(ly + y + fy) - qy) * iy;
    } else {
        z += sz;
        tz = ((double)(lz + z + fz) - qz) * iz;
    }
} while (!((x | y | z) & ~7));
if (!(ta <= last)) break;
bx = lx + x;
by = ly + y;
bz = lz + z;
