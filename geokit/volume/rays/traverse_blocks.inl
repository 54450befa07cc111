// The walk of traverse.inl through the tables of crossing_blocks_kernels, if there are any; it then sets `crosses` to
// false.
//
// Expects the names of traverse.inl, reach, numbers, first_block, block_count and blocks (see
// crossing_blocks_kernels); the constant BLOCK_WORDS; the macro SIDE_BY_SIDE: 1 if ray_packet_cpu.inl has set `known`
// to the distance of the first block.
// Hooks: BLOCK_CELLS, a file, steps through the cells of a block that may hold a crossing; ON_UNSEEN runs after blocks
// or cells were crossed without reading their voxels.
if (reach.shape[0] != 0) {
    // The distances ahead, for rays of this octant.
    const signed char* const ahead =
        (const signed char*)reach.data + (long long)(reach.shape[0] >> 3) * ((1 - fx) << 2 | (1 - fy) << 1 | (1 - fz));
    while (crosses) {
        auto here = [&]() {
            return (((bx >> 3) - first_block[0]) * block_count[1] + ((by >> 3) - first_block[1])) * block_count[2]
                   + ((bz >> 3) - first_block[2]);
        };
        // Distance [blocks] to the nearest busy block ahead.
#if SIDE_BY_SIDE
        int clear = known;
        known = 1;
        if (clear > 0) clear = ahead[here()];
#else
        int clear = ahead[here()];
#endif
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
            unseen = along_x ? 4 * (1 - fx) : along_y ? 2 * (1 - fy) : 1 - fz;
            ON_UNSEEN
        }
        if (clear < 0 || !(ta <= last)) break;
        const int number = numbers.data[here()];
        const address* block = (const address*)blocks.data + BLOCK_WORDS * (address)number;
        const address* nodes = block + 8;
#include BLOCK_CELLS
    }
    crosses = false;
}
