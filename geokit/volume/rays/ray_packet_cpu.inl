// The steps that all rays of a packet take alike, in SIMD: into index space, into the box, and the jumps to the first
// block that may hold a crossing.
//
// Expects the types of core/simd.inl; field, a RayField; start, stop, origins, directions, t_min, max_distance; the
// constants G (rays of a packet), SHORTEST_DIRECTION and BLOCK_WORDS. Defines rays, a struct of arrays; found, the
// list of cells in which a root is bracketed, still empty; count; origins (ox, oy, oz) and directions (rx, ry, rz);
// m00 to m22. Returns 1 if a ray is not usable. RAY_*(X) and BRACKET(X) list the names.
//
// Loops whose reads are scattered are not vectorized: see trilinear_cells.inl.
#define RAY_REALS(X) X(qx) X(qy) X(qz) X(dx) X(dy) X(dz) X(ix) X(iy) X(iz) X(t_first) X(t_last) X(t0) X(last)
#define RAY_FLAGS(X) X(fx) X(fy) X(fz) X(entered) X(left)
#define RAY_STATE(X) X(bx) X(by) X(bz) X(crosses) X(unseen)
// clang-format off
#define BRACKET(X)                                                                 \
    X(p0) X(p1) X(p2) X(p3) X(lo) X(hi) X(at_lo) X(at_hi) \
    X(ta) X(tb) X(ex) X(ey) X(ez) X(gx) X(gy) X(gz) \
    X(kx) X(ky) X(kz) X(kxy) X(kxz) X(kyz) X(kxyz)
// clang-format on
#define REALS(name) double name[G];
#define INTS(name) int name[G];
struct Rays {
    RAY_REALS(REALS)
    REALS(scale)
    REALS(ta)
    RAY_FLAGS(INTS)
    RAY_STATE(INTS)
    INTS(clear)
} rays;
struct Brackets {
    int count, row[G];
    BRACKET(REALS)
} found;
#undef REALS
#undef INTS
found.count = 0;

// The rays from `start` on, by the operations of index_ray. Lanes without a ray repeat the first ray.
const double lower[3] = {field.lower[0], field.lower[1], field.lower[2]};
const double upper[3] = {field.upper[0], field.upper[1], field.upper[2]};
const double cx = field.corner[0], cy = field.corner[1], cz = field.corner[2];
const auto& to_index = field.to_index;
#include "volume/sampling/matrix.inl"
const int count = stop - start < G ? stop - start : G;
double ox[G], oy[G], oz[G], rx[G], ry[G], rz[G];
    #pragma clang loop vectorize(disable)
for (int q = 0; q < G; ++q) {
    const long long row = start + (q < count ? q : 0);
    const double* const o = (const double*)origins.data + 3 * row;
    const double* const d = (const double*)directions.data + 3 * row;
    ox[q] = o[0];
    oy[q] = o[1];
    oz[q] = o[2];
    rx[q] = d[0];
    ry[q] = d[1];
    rz[q] = d[2];
}
int useless[G];
for (int q = 0; q < G; ++q) {
    const double largest = wp::max(wp::max(wp::abs(rx[q]), wp::abs(ry[q])), wp::abs(rz[q]));
    const double lost =
        ((ox[q] - ox[q]) + (rx[q] - rx[q])) + ((oy[q] - oy[q]) + (ry[q] - ry[q])) + ((oz[q] - oz[q]) + (rz[q] - rz[q]));
    useless[q] = !((largest >= SHORTEST_DIRECTION) & (lost == 0.0));
    const double x = rx[q] / largest, y = ry[q] / largest, z = rz[q] / largest;
    const double tx = m00 * x + m01 * y + m02 * z, ty = m10 * x + m11 * y + m12 * z;
    const double tz = m20 * x + m21 * y + m22 * z;
    const double voxels = wp::max(wp::max(wp::abs(tx), wp::abs(ty)), wp::abs(tz)), scale = voxels * largest;
    const double t_first = t_min * scale;
    const double t_last = max_distance / __builtin_elementwise_sqrt(x * x + y * y + z * z) * voxels;
    const double ax = ox[q] - cx, ay = oy[q] - cy, az = oz[q] - cz;
    const double start[3] = {m00 * ax + m01 * ay + m02 * az, m10 * ax + m11 * ay + m12 * az,
                             m20 * ax + m21 * ay + m22 * az};
    const double toward[3] = {tx / voxels, ty / voxels, tz / voxels};
#include "volume/rays/ray_box.inl"
    const double ta = 0.0;
    const int clear = -1, unseen = -1;
#define KEEP(name) rays.name[q] = name;
    RAY_REALS(KEEP)
    KEEP(scale)
    KEEP(ta)
    RAY_FLAGS(KEEP)
    RAY_STATE(KEEP)
    KEEP(clear)
#undef KEEP
}
int bad = 0;
for (int q = 0; q < G; ++q) bad |= useless[q];
if (bad) return 1;

// The jumps of traverse_blocks.inl, four rays at a time, until each ray is in a block that may hold a crossing
// (`clear` is 0) or has left the box (-1). Vectors of eight would be wider than the registers at which processors
// run at full speed.
typedef decltype(d4() < d4()) l4;
auto narrow = [](l4 mask) { return __builtin_convertvector(mask, i4); };
auto real = [](i4 number) { return __builtin_convertvector(number, d4); };
const signed char* const reach = (const signed char*)field.reach.data;
const int blocks_x = field.first_block[0], blocks_y = field.first_block[1], blocks_z = field.first_block[2];
const int count_y = field.block_count[1], count_z = field.block_count[2], of_octant = field.reach.shape[0] >> 3;
int in_block[G];
for (int q = 0; q < G; q += 4) {
    auto reals = [&](const double* at) { return *(const d4*)(at + q); };
    auto ints = [&](const int* at) { return *(const i4*)(at + q); };
    const d4 qx = reals(rays.qx), qy = reals(rays.qy), qz = reals(rays.qz);
    const d4 dx = reals(rays.dx), dy = reals(rays.dy), dz = reals(rays.dz);
    const d4 ix = reals(rays.ix), iy = reals(rays.iy), iz = reals(rays.iz), last = reals(rays.last);
    // -1 for a ray that goes backwards along the axis.
    const i4 back_x = ints(rays.fx) - 1, back_y = ints(rays.fy) - 1, back_z = ints(rays.fz) - 1;
    const i4 octant = (back_x * -4 + back_y * -2 - back_z) * of_octant;
    i4 bx = ints(rays.bx), by = ints(rays.by), bz = ints(rays.bz), alive = -ints(rays.crosses);
    i4 unseen = -1, clear, here;
    d4 ta = 0.0;
    for (;;) {
        here = (((bx >> 3) - blocks_x) * count_y + ((by >> 3) - blocks_y)) * count_z + ((bz >> 3) - blocks_z);
        const i4 at = (here + octant) & alive;
        clear = (i4){reach[at[0]], reach[at[1]], reach[at[2]], reach[at[3]]} | ~alive;
        const i4 jumps = clear > 0;
        if (!__builtin_reduce_or(jumps)) break;
        const i4 span = clear * 8;
        auto end_of = [&](i4 b, i4 back) { return (b & ~7) + (back ? 8 - span : span); };
        const i4 ex = end_of(bx, back_x), ey = end_of(by, back_y), ez = end_of(bz, back_z);
        const d4 tx = (real(ex) - qx) * ix, ty = (real(ey) - qy) * iy, tz = (real(ez) - qz) * iz;
        const l4 first_x = (tx <= ty) & (tx <= tz), first_y = ~first_x & (ty <= tz);
        const d4 t = first_x ? tx : first_y ? ty : tz, next = t > ta ? t : ta;
        const i4 along_x = narrow(first_x), along_y = narrow(first_y), along_z = ~(along_x | along_y);
        const i4 stays = jumps & narrow(next <= last);
        auto move = [&](i4 b, i4 along, i4 back, i4 end, d4 from, d4 d) {
            const i4 low = (b & ~7) + (back & (8 - span));
            const d4 above = (from + next * d) - real(low), most = real(span - 1);
            const d4 capped = above < most ? above : most, within = capped > 0.0 ? capped : 0.0;
            return stays ? (along ? end + back : low + __builtin_convertvector(within, i4)) : b;
        };
        bx = move(bx, along_x, back_x, ex, qx, dx);
        by = move(by, along_y, back_y, ey, qy, dy);
        bz = move(bz, along_z, back_z, ez, qz, dz);
        ta = __builtin_convertvector(jumps, l4) ? next : ta;
        unseen = jumps ? (along_x ? back_x * -4 : along_y ? back_y * -2 : -back_z) : unseen;
        alive &= stays | ~jumps;
    }
    *(i4*)(rays.bx + q) = bx;
    *(i4*)(rays.by + q) = by;
    *(i4*)(rays.bz + q) = bz;
    *(i4*)(rays.clear + q) = clear;
    *(i4*)(rays.unseen + q) = unseen;
    *(d4*)(rays.ta + q) = ta;
    *(i4*)(in_block + q) = here & (clear == 0);
}
    #pragma clang loop vectorize(disable)
for (int q = 0; q < G; ++q) {
    const auto* const block = field.blocks.data + BLOCK_WORDS * (long long)field.numbers.data[in_block[q]];
    __builtin_prefetch(block);
    __builtin_prefetch(block + 8);
}
