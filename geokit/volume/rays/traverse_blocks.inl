// The walk of traverse.inl through the tables of crossing_blocks_kernels.
#pragma once
#include "volume/nanovdb/cached_accessor.inl"
#include "volume/rays/ray.inl"

// The ray passes a cell of a block, up to the border `next`: on_cell(c, mixed) if the cell may hold a crossing.
static constexpr auto pass_cell = [](auto& in, const address* nodes, Ray& ray, int lx, int ly, int lz, int x, int y,
                                     int z, double next, auto&& on_cell) -> bool {
    ray.bx = lx + x;
    ray.by = ly + y;
    ray.bz = lz + z;
    ray.tb = next < ray.last ? next : ray.last;
    decltype(in.background) c[8];
    if (!read_leaf_cell(in, nodes[0], x, y, z, c))
        for (int m = 0; m < 8; ++m) {
            const int i = x + (m >> 2), j = y + (m >> 1 & 1), k = z + (m & 1);
            c[m] = voxel(in, nodes[i >> 3 << 2 | j >> 3 << 1 | k >> 3], lx + i, ly + j, lz + k);
        }
    if (on_cell(c, true)) return true;
    ray.unseen = -1;
    return false;
};

// Steps from cell to cell of a block, with a branch on the axis of the next border; whether the walk ends.
static constexpr auto pass_block = [](auto& in, const address* block, Ray& ray, auto&& on_unseen,
                                      auto&& on_cell) -> bool {
    const double &qx = ray.qx, &qy = ray.qy, &qz = ray.qz, &ix = ray.ix, &iy = ray.iy, &iz = ray.iz;
    const int &fx = ray.fx, &fy = ray.fy, &fz = ray.fz;
    const int lx = ray.bx & ~7, ly = ray.by & ~7, lz = ray.bz & ~7;
    int x = ray.bx - lx, y = ray.by - ly, z = ray.bz - lz;
    double tx = ((double)(ray.bx + fx) - qx) * ix, ty = ((double)(ray.by + fy) - qy) * iy,
           tz = ((double)(ray.bz + fz) - qz) * iz;
    do {
        const bool along_x = tx <= ty && tx <= tz, along_y = !along_x && ty <= tz;
        const double t = along_x ? tx : along_y ? ty : tz;
        const double next = t > ray.ta ? t : ray.ta;
        if (block[x] >> (y << 3 | z) & 1) {
            // The ray ends in this block, before this cell.
            if (!(ray.ta <= ray.last)) break;
            if (pass_cell(in, block + 8, ray, lx, ly, lz, x, y, z, next, on_cell)) return true;
        } else {
            ray.unseen = along_x ? 4 * (1 - fx) : along_y ? 2 * (1 - fy) : 1 - fz;
            on_unseen();
        }
        ray.ta = next;
        if (along_x) {
            x += ray.sx;
            tx = ((double)(lx + x + fx) - qx) * ix;
        } else if (along_y) {
            y += ray.sy;
            ty = ((double)(ly + y + fy) - qy) * iy;
        } else {
            z += ray.sz;
            tz = ((double)(lz + z + fz) - qz) * iz;
        }
    } while (!((x | y | z) & ~7));
    ray.bx = lx + x;
    ray.by = ly + y;
    ray.bz = lz + z;
    return false;
};

// From the ray's cell on, until the walk ends or the ray leaves the box; whether it ended. `known` is the distance of
// the first block if a caller knows it, else -2. Hooks: pass(block), whether the walk ends in the cells of a block that
// may hold a crossing; on_unseen(), after blocks were crossed without reading their voxels.
static constexpr auto traverse_blocks = [](const RayField& field, Ray& ray, int known, auto&& pass,
                                           auto&& on_unseen) -> bool {
    const double &qx = ray.qx, &qy = ray.qy, &qz = ray.qz, &dx = ray.dx, &dy = ray.dy, &dz = ray.dz;
    const double &ix = ray.ix, &iy = ray.iy, &iz = ray.iz, &last = ray.last;
    const int &fx = ray.fx, &fy = ray.fy, &fz = ray.fz;
    int &bx = ray.bx, &by = ray.by, &bz = ray.bz;
    double& ta = ray.ta;
    // The distances ahead, for rays of this octant.
    const signed char* const ahead =
        (const signed char*)field.reach.data
        + (long long)(field.reach.shape[0] >> 3) * ((1 - fx) << 2 | (1 - fy) << 1 | (1 - fz));
    auto here = [&]() {
        return (((bx >> 3) - field.first_block[0]) * field.block_count[1] + ((by >> 3) - field.first_block[1]))
                   * field.block_count[2]
               + ((bz >> 3) - field.first_block[2]);
    };
    while (ray.crosses) {
        // Distance [blocks] to the nearest busy block ahead.
        int clear = known > -2 ? known : ahead[here()];
        known = -2;
        bool along_x = false, along_y = false;
        if (clear > 0) {
            do {
                // No block nearer than this distance holds a crossing, so the ray jumps out of the cube of these
                // blocks.
                const int span = 8 * clear, beyond = span - 8;
                const int lx = (bx & ~7) - (fx ? 0 : beyond), ly = (by & ~7) - (fy ? 0 : beyond),
                          lz = (bz & ~7) - (fz ? 0 : beyond);
                const double tx = ((double)(lx + fx * span) - qx) * ix, ty = ((double)(ly + fy * span) - qy) * iy,
                             tz = ((double)(lz + fz * span) - qz) * iz;
                along_x = (tx <= ty) & (tx <= tz);
                along_y = !along_x & (ty <= tz);
                const double t = pick(along_x, tx, pick(along_y, ty, tz));
                ta = t > ta ? t : ta;
                if (!(ta <= last)) break;
                bx = along_x ? (fx ? lx + span : lx - 1) : within(qx + ta * dx, lx, span);
                by = along_y ? (fy ? ly + span : ly - 1) : within(qy + ta * dy, ly, span);
                bz = !(along_x | along_y) ? (fz ? lz + span : lz - 1) : within(qz + ta * dz, lz, span);
                clear = ahead[here()];
            } while (clear > 0);
            ray.unseen = along_x ? 4 * (1 - fx) : along_y ? 2 * (1 - fy) : 1 - fz;
            on_unseen();
        }
        if (clear < 0 || !(ta <= last)) break;
        const int number = field.numbers.data[here()];
        if (pass((const address*)field.blocks.data + BLOCK_WORDS * (address)number)) return true;
        if (!(ta <= last)) break;
    }
    return false;
};
