// A walk along a ray through the cells of a NanoVDB grid, which crosses constant regions in one step.
//
// A cell is the cube between eight voxel centers, named by its lowest voxel. The cells of an aligned block of 8^3
// need the voxels of up to eight blocks.
#pragma once
#include "volume/nanovdb/cached_accessor.inl"
#include "volume/rays/ray.inl"

// Hooks; the last two say whether the walk ends, which is what it returns:
// - same(value, other): whether adjacent blocks of these values can be crossed in one step.
// - on_region(value): the interpolant has the value, up to `same`, between ta and tb.
// - on_cell(c, mixed): the ray is between ta and tb in the cell (bx, by, bz), whose voxels are c[0] to c[7], k fastest.
//   `mixed` if these are known not to be all above or all below the isovalue.
static constexpr auto traverse = [](auto& in, Ray& ray, auto&& same, auto&& on_region, auto&& on_cell) -> bool {
    typedef decltype(in.background) real;
    const double &qx = ray.qx, &qy = ray.qy, &qz = ray.qz, &dx = ray.dx, &dy = ray.dy, &dz = ray.dz;
    const double &ix = ray.ix, &iy = ray.iy, &iz = ray.iz, &last = ray.last;
    const int &fx = ray.fx, &fy = ray.fy, &fz = ray.fz;
    int &bx = ray.bx, &by = ray.by, &bz = ray.bz, ignored;
    double &ta = ray.ta, &tb = ray.tb;
    while (ray.crosses && ta <= last) {
        const int gi = (int)((unsigned)bx + (unsigned)in.anchor[0]), gj = (int)((unsigned)by + (unsigned)in.anchor[1]),
                  gk = (int)((unsigned)bz + (unsigned)in.anchor[2]);
        int size;
        address node = descend(in, gi, gj, gk, size);
        if (node == 0) node = leaf_or_tile(in, gi, gj, gk);
        const bool in_leaf = node & 1;
        real value = (real)0;
        // First cell of the region that this step crosses; `cells` is its number of cells along each edge.
        int lx = bx - ((int)((unsigned)bx + (unsigned)in.anchor[0]) & (size - 1)),
            ly = by - ((int)((unsigned)by + (unsigned)in.anchor[1]) & (size - 1)),
            lz = bz - ((int)((unsigned)bz + (unsigned)in.anchor[2]) & (size - 1));
        if (!in_leaf) {
            value = voxel(in, node, bx, by, bz);
            int cells = 8;
            if (size > 8 && bx - lx < size - 1 && by - ly < size - 1 && bz - lz < size - 1) {
                cells = size - 1;  // the last cells of a tile also reach the voxels beside it
            } else {
                lx = bx - (bx & 7);
                ly = by - (by & 7);
                lz = bz - (bz & 7);
            }
            const double tx = ((double)lx + fx * cells - qx) * ix, ty = ((double)ly + fy * cells - qy) * iy,
                         tz = ((double)lz + fz * cells - qz) * iz;
            const bool along_x = tx <= ty && tx <= tz, along_y = !along_x && ty <= tz;
            const double ahead = wp::max(ta, along_x ? tx : along_y ? ty : tz);
            bool alike = true;
            if (cells == 8) {
                // Neighbors whose voxels the ray's cells read within this block.
                const double end = wp::min(ahead, last);
                const int seen = (qx + (fx ? end : ta) * dx > (double)(lx + 7) ? 1 : 0)
                                 | (qy + (fy ? end : ta) * dy > (double)(ly + 7) ? 2 : 0)
                                 | (qz + (fz ? end : ta) * dz > (double)(lz + 7) ? 4 : 0);
                for (int m = 1; m < 8 && alike; ++m) {
                    if (m & ~seen) continue;
                    const int x = lx + 8 * (m & 1), y = ly + 4 * (m & 2), z = lz + 2 * (m & 4);
                    const address beside = find(in, x, y, z, ignored);
                    alike = !(beside & 1);
                    if (alike) {
                        const real other = voxel(in, beside, x, y, z);
                        alike = same(value, other);
                    }
                }
            }
            if (alike) {
                tb = wp::min(ahead, last);
                ray.unseen = -1;
                if (on_region(value)) return true;
                ta = ahead;
                bx = along_x ? (fx ? lx + cells : lx - 1) : within(qx + ta * dx, lx, cells);
                by = along_y ? (fy ? ly + cells : ly - 1) : within(qy + ta * dy, ly, cells);
                bz = !along_x && !along_y ? (fz ? lz + cells : lz - 1) : within(qz + ta * dz, lz, cells);
                continue;
            }
        }
        address beside[8] = {node, 0, 0, 0, 0, 0, 0, 0};
        double tx = ((double)(bx + fx) - qx) * ix, ty = ((double)(by + fy) - qy) * iy,
               tz = ((double)(bz + fz) - qz) * iz;
        for (;;) {
            const bool along_x = tx <= ty && tx <= tz, along_y = !along_x && ty <= tz;
            const double next = wp::max(ta, along_x ? tx : along_y ? ty : tz);
            tb = wp::min(next, last);
            const int x = bx - lx, y = by - ly, z = bz - lz;
            real c[8];
            if (!read_leaf_cell(in, node, x, y, z, c))
                for (int m = 0; m < 8; ++m) {
                    const int i = x + (m >> 2), j = y + (m >> 1 & 1), k = z + (m & 1);
                    const int block = i >> 3 << 2 | j >> 3 << 1 | k >> 3;
                    if (beside[block] == 0) beside[block] = find(in, lx + i, ly + j, lz + k, ignored);
                    c[m] = voxel(in, beside[block], lx + i, ly + j, lz + k);
                }
            if (on_cell(c, false)) return true;
            ray.unseen = -1;
            ta = next;
            if (!(ta <= last)) break;
            if (along_x) {
                bx += ray.sx;
                tx = ((double)(bx + fx) - qx) * ix;
            } else if (along_y) {
                by += ray.sy;
                ty = ((double)(by + fy) - qy) * iy;
            } else {
                bz += ray.sz;
                tz = ((double)(bz + fz) - qz) * iz;
            }
            if (((bx - lx) | (by - ly) | (bz - lz)) & ~7) break;
        }
    }
    return false;
};
