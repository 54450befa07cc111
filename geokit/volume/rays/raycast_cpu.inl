// The first crossings of a packet of rays on a CPU. Vector arithmetic takes the steps that all rays share: into the
// box, the jumps to the first block that may hold a crossing, the root iteration in a cell, and the world point and
// normal. The walk in between is scalar. All operations are those of raycast.inl and write_hit, so answers agree to
// the last bit.
//
// Loops whose reads are scattered are not vectorized: see trilinear_cpu.inl.
#include "core/simd.inl"
#include "volume/rays/crossing.inl"
#include "volume/rays/traverse_blocks.inl"

// RAY_*(X) and BRACKET(X) list members.
#define RAY_REALS(X) X(qx) X(qy) X(qz) X(dx) X(dy) X(dz) X(ix) X(iy) X(iz) X(t_first) X(t_last) X(t0) X(last) X(ta)
#define RAY_INTS(X) X(fx) X(fy) X(fz) X(entered) X(left) X(bx) X(by) X(bz) X(crosses) X(unseen)
// clang-format off
#define CUBIC(X)                                                                  \
    X(p0) X(p1) X(p2) X(p3) X(ex) X(ey) X(ez) X(gx) X(gy) X(gz) \
    X(kx) X(ky) X(kz) X(kxy) X(kxz) X(kyz) X(kxyz)
#define ENDS(X) X(lo) X(hi) X(at_lo) X(at_hi)
#define BRACKET(X) CUBIC(X) ENDS(X) X(ta) X(tb)
// clang-format on
#define REALS(name) double name[G];
#define INTS(name) int name[G];
// A packet of rays on their way, and the distance of the first block that may hold a crossing.
struct Rays {
    RAY_REALS(REALS)
    REALS(scale)
    RAY_INTS(INTS)
    INTS(clear)
};
// The cells in which a root is bracketed.
struct Brackets {
    int count, row[G];
    BRACKET(REALS)
};
#undef REALS
#undef INTS
// The rays in world space, then the crossings: t, the points and the gradients.
struct World {
    double ox[G], oy[G], oz[G], rx[G], ry[G], rz[G], hit[G], sx[G], sy[G], sz[G];
};

// The rays from `start` on, by the operations of index_ray; whether all are usable. Lanes without a ray repeat the first
// ray.
static constexpr auto read_packet = [](int start, int count, const wp::array_t<wp::vec3d>& origins,
                                       const wp::array_t<wp::vec3d>& directions, const RayField& field, double t_min,
                                       double max_distance, World& world, Rays& rays) -> bool {
    const double lower[3] = {field.lower[0], field.lower[1], field.lower[2]};
    const double upper[3] = {field.upper[0], field.upper[1], field.upper[2]};
    const double cx = field.corner[0], cy = field.corner[1], cz = field.corner[2];
    const wp::mat33d to_index = field.to_index;
    const auto& m = to_index.data;
    double (&ox)[G] = world.ox, (&oy)[G] = world.oy, (&oz)[G] = world.oz;
    double (&rx)[G] = world.rx, (&ry)[G] = world.ry, (&rz)[G] = world.rz;
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
        const double lost = ((ox[q] - ox[q]) + (rx[q] - rx[q])) + ((oy[q] - oy[q]) + (ry[q] - ry[q]))
                            + ((oz[q] - oz[q]) + (rz[q] - rz[q]));
        useless[q] = !((largest >= SHORTEST_DIRECTION) & (lost == 0.0));
        const double x = rx[q] / largest, y = ry[q] / largest, z = rz[q] / largest;
        const double tx = m[0][0] * x + m[0][1] * y + m[0][2] * z, ty = m[1][0] * x + m[1][1] * y + m[1][2] * z;
        const double tz = m[2][0] * x + m[2][1] * y + m[2][2] * z;
        const double voxels = wp::max(wp::max(wp::abs(tx), wp::abs(ty)), wp::abs(tz)), scale = voxels * largest;
        const double t_first = t_min * scale;
        const double t_last = max_distance / __builtin_elementwise_sqrt(x * x + y * y + z * z) * voxels;
        const double ax = ox[q] - cx, ay = oy[q] - cy, az = oz[q] - cz;
        const double start[3] = {m[0][0] * ax + m[0][1] * ay + m[0][2] * az, m[1][0] * ax + m[1][1] * ay + m[1][2] * az,
                                 m[2][0] * ax + m[2][1] * ay + m[2][2] * az};
        const double toward[3] = {tx / voxels, ty / voxels, tz / voxels};
        const Ray ray = into_box(lower, upper, start, toward, t_first, t_last);
#define KEEP(name) rays.name[q] = ray.name;
        RAY_REALS(KEEP)
        RAY_INTS(KEEP)
#undef KEEP
        rays.scale[q] = scale;
        rays.clear[q] = -1;
    }
    int bad = 0;
    for (int q = 0; q < G; ++q) bad |= useless[q];
    return bad == 0;
};

// The jumps of traverse_blocks.inl, four rays at a time, until each ray is in a block that may hold a crossing
// (`clear` is 0) or has left the box (-1). Vectors of eight would be wider than the registers at which processors
// run at full speed.
static constexpr auto jump = [](const RayField& field, Rays& rays) {
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
};

// Steps from cell to cell of a block without branches: the borders after the next are computed before one is chosen.
// Random rays are 8% faster than with the branches of pass_block, camera rays 3% slower.
static constexpr auto pass_block_cpu = [](auto& in, const address* block, Ray& ray, auto&& on_unseen,
                                          auto&& on_cell) -> bool {
    const double &qx = ray.qx, &qy = ray.qy, &qz = ray.qz, &ix = ray.ix, &iy = ray.iy, &iz = ray.iz, &last = ray.last;
    const int &sx = ray.sx, &sy = ray.sy, &sz = ray.sz, &fx = ray.fx, &fy = ray.fy, &fz = ray.fz;
    const double step_x = sx, step_y = sy, step_z = sz;
    double& ta = ray.ta;
    const int lx = ray.bx & ~7, ly = ray.by & ~7, lz = ray.bz & ~7;
    // Ray parameters of the next borders (t), and positions and ray parameters of the borders after them (a, u).
    double ax = (double)(ray.bx + fx), ay = (double)(ray.by + fy), az = (double)(ray.bz + fz);
    double tx = (ax - qx) * ix, ty = (ay - qy) * iy, tz = (az - qz) * iz;
    ax += step_x;
    ay += step_y;
    az += step_z;
    double ux = (ax - qx) * ix, uy = (ay - qy) * iy, uz = (az - qz) * iz;
    // Coordinates in the block plus 8, packed into ten bits each.
    int cell = (ray.bx - lx + 8) << 20 | (ray.by - ly + 8) << 10 | (ray.bz - lz + 8);
    do {
        const bool along_x = (tx <= ty) & (tx <= tz);
        const bool along_y = !along_x & (ty <= tz);
        const double t = pick(along_x, tx, pick(along_y, ty, tz));
        const double next = t > ta ? t : ta;
        if (block[cell >> 20 & 7] >> ((cell >> 7 & 56) | (cell & 7)) & 1) {
            // The ray ends in this block, before this cell.
            if (!(ta <= last)) break;
            const int x = cell >> 20 & 7, y = cell >> 10 & 7, z = cell & 7;
            if (pass_cell(in, block + 8, ray, lx, ly, lz, x, y, z, next, on_cell)) return true;
        } else {
            ray.unseen = pick(along_x, 4 * (1 - fx), pick(along_y, 2 * (1 - fy), 1 - fz));
            on_unseen();
        }
        ta = next;
        const bool along_z = !(along_x | along_y);
        cell += pick(along_x, sx * (1 << 20), pick(along_y, sy * (1 << 10), sz));
        tx = pick(along_x, ux, tx);
        ty = pick(along_y, uy, ty);
        tz = pick(along_z, uz, tz);
        ax = pick(along_x, ax + step_x, ax);
        ay = pick(along_y, ay + step_y, ay);
        az = pick(along_z, az + step_z, az);
        ux = (ax - qx) * ix;
        uy = (ay - qy) * iy;
        uz = (az - qz) * iz;
    } while (!((cell ^ 0x802008) & ~0x701c07));
    ray.bx = lx + (cell >> 20) - 8;
    ray.by = ly + (cell >> 10 & 31) - 8;
    ray.bz = lz + (cell & 31) - 8;
    return false;
};

// The walk of a ray from where the jumps left it. A separate function, so that it has all registers; it returns no
// Crossing, which would then live in memory.
static constexpr auto walk = [](const RayField& field, const Rays& rays, int q, double isovalue, auto below, auto above,
                                Brackets& found) __attribute__((noinline)) -> wp::vec4d {
    typedef decltype(below + below) real;
    auto in = opened(field.volume, field.anchor, real());
    Ray ray;
#define LOAD(name) ray.name = rays.name[q];
    RAY_REALS(LOAD)
    RAY_INTS(LOAD)
#undef LOAD
    ray.sx = ray.fx ? 1 : -1;
    ray.sy = ray.fy ? 1 : -1;
    ray.sz = ray.fz ? 1 : -1;
    ray.tb = 0.0;
    Crossing crossing;
    const bool ends = begin_search(ray, in.background, below, above, crossing);
    auto on_unseen = [&]() { crossing.side = 0; };
    if (ray.unseen >= 0) on_unseen();
    // The root is iterated to beside others, provided that no value or slope of the cubic overflows.
    auto put_off = [&](const Cubic& cubic, const Bracket& bracket) -> bool {
        const double p0 = cubic.p0, p1 = cubic.p1, p2 = cubic.p2, p3 = cubic.p3;
        if (!(wp::abs(p0) + wp::abs(p1) + wp::abs(p2) + wp::abs(p3) < LARGEST_SUM)) return false;
        const int n = found.count++;
        found.row[n] = q;
#define KEEP(name) found.name[n] = cubic.name;
        CUBIC(KEEP)
#undef KEEP
#define KEEP(name) found.name[n] = bracket.name;
        ENDS(KEEP)
#undef KEEP
        found.ta[n] = ray.ta;
        found.tb[n] = ray.tb;
        return true;
    };
    auto on_cell = [&](const real* c, bool mixed) {
        return crosses_cell(ray, c, mixed, isovalue, below, above, crossing, put_off);
    };
    auto pass = [&](const address* block) { return pass_block_cpu(in, block, ray, on_unseen, on_cell); };
    if (!ends && !traverse_blocks(field, ray, rays.clear[q], pass, on_unseen))
        end_search(ray, in.background, below, above, crossing);
    return wp::vec4d(crossing.hit, crossing.slope[0], crossing.slope[1], crossing.slope[2]);
};

// The root iteration of crosses_cell for eight cells at a time; spare lanes repeat the first cell.
static constexpr auto find_roots = [](const Rays& rays, Brackets& found, World& world) {
    for (int n = found.count; n < ((found.count + 7) & ~7); ++n) {
        found.row[n] = found.row[0];
#define REPEAT(name) found.name[n] = found.name[0];
        BRACKET(REPEAT)
#undef REPEAT
    }
    for (int base = 0; base < found.count; base += 8) {
        double s[8], left_end[8], right_end[8], moved[8];
        int going[8];
        for (int n = 0; n < 8; ++n) {
            const double lo = found.lo[base + n], hi = found.hi[base + n], at_lo = found.at_lo[base + n];
            s[n] = lo + (hi - lo) * (at_lo / (at_lo - found.at_hi[base + n]));
            left_end[n] = lo;
            right_end[n] = hi;
            moved[n] = hi - lo;
            going[n] = 1;
        }
        for (int round = 0; round < ROUNDS; ++round) {
            int some = 0;
            for (int n = 0; n < 8; ++n) {
                const double p0 = found.p0[base + n], p1 = found.p1[base + n], p2 = found.p2[base + n];
                const double p3 = found.p3[base + n], at = s[n];
                const double v = ((p3 * at + p2) * at + p1) * at + p0;
                const bool on = (going[n] != 0) & !(v == 0.0), is_left = (v > 0.0) == (found.at_lo[base + n] > 0.0);
                const double left = is_left ? at : left_end[n], right = is_left ? right_end[n] : at;
                const double rise = (3.0 * p3 * at + 2.0 * p2) * at + p1, newton = at - v / rise;
                const bool quick = __builtin_fabs(newton - at) <= 0.5 * moved[n];
                const double better = ((newton >= left) & (newton <= right) & quick) ? newton : 0.5 * (left + right);
                left_end[n] = left;
                right_end[n] = right;
                moved[n] = __builtin_fabs(better - at);
                s[n] = on ? better : at;
                const int more = on & !(moved[n] <= RESOLUTION);
                going[n] = more;
                some |= more;
            }
            if (!some) break;
        }
        double t[8], x[8], y[8], z[8];
        for (int n = 0; n < 8; ++n) {
            const int m = base + n;
            t[n] = found.ta[m] + s[n] * (found.tb[m] - found.ta[m]);
            const double ux = found.ex[m] + s[n] * found.gx[m], uy = found.ey[m] + s[n] * found.gy[m];
            const double uz = found.ez[m] + s[n] * found.gz[m];
            x[n] = (found.kx[m] + uy * found.kxy[m]) + uz * (found.kxz[m] + uy * found.kxyz[m]);
            y[n] = (found.ky[m] + ux * found.kxy[m]) + uz * (found.kyz[m] + ux * found.kxyz[m]);
            z[n] = (found.kz[m] + ux * found.kxz[m]) + uy * (found.kyz[m] + ux * found.kxyz[m]);
        }
            #pragma clang loop vectorize(disable)
        for (int n = 0; n < 8; ++n) {
            const int q = found.row[base + n];
            world.hit[q] = rays.t0[q] + t[n];
            world.sx[q] = x[n];
            world.sy[q] = y[n];
            world.sz[q] = z[n];
        }
    }
};

// Writes the hits of the rays of a packet; sets out_bad and writes nothing if a ray is not usable.
static constexpr auto first_crossings = [](int packet, const wp::array_t<wp::vec3d>& origins,
                                           const wp::array_t<wp::vec3d>& directions, const RayField& field,
                                           double t_min, double max_distance, double isovalue, auto below, auto above,
                                           wp::array_t<double>& out_t, wp::array_t<wp::vec3d>& out_points,
                                           wp::array_t<wp::vec3d>& out_normals, wp::array_t<int>& out_bad) {
    const int start = packet * G, left = origins.shape[0] - start, count = left < G ? left : G;
    World world;
    Rays rays;
    Brackets found;
    found.count = 0;
    if (!read_packet(start, count, origins, directions, field, t_min, max_distance, world, rays)) {
        out_bad.data[0] = 1;
        return;
    }
    jump(field, rays);
    double (&ox)[G] = world.ox, (&oy)[G] = world.oy, (&oz)[G] = world.oz, (&hit)[G] = world.hit;
    double (&sx)[G] = world.sx, (&sy)[G] = world.sy, (&sz)[G] = world.sz;
    const double (&rx)[G] = world.rx, (&ry)[G] = world.ry, (&rz)[G] = world.rz;
    #pragma clang loop vectorize(disable)
    for (int q = 0; q < G; ++q) {
        hit[q] = sx[q] = sy[q] = sz[q] = 0.0;
        if (q >= count) continue;
        const wp::vec4d met = walk(field, rays, q, isovalue, below, above, found);
        hit[q] = met[0];
        sx[q] = met[1];
        sy[q] = met[2];
        sz[q] = met[3];
    }
    find_roots(rays, found, world);
    // The operations of write_hit.
    const wp::mat33d to_index = field.to_index;
    const auto& m = to_index.data;
    for (int q = 0; q < G; ++q) {
        const bool none = hit[q] == (double)INFINITY;
        const double t = hit[q] / rays.scale[q], nan = (double)NAN;
        const double x = m[0][0] * sx[q] + m[1][0] * sy[q] + m[2][0] * sz[q],
                     y = m[0][1] * sx[q] + m[1][1] * sy[q] + m[2][1] * sz[q];
        const double z = m[0][2] * sx[q] + m[1][2] * sy[q] + m[2][2] * sz[q];
        const double size = __builtin_elementwise_sqrt(x * x + y * y + z * z);
        hit[q] = none ? hit[q] : t;
        ox[q] = none ? nan : ox[q] + rx[q] * t;
        oy[q] = none ? nan : oy[q] + ry[q] * t;
        oz[q] = none ? nan : oz[q] + rz[q] * t;
        sx[q] = none ? nan : size > 0.0 ? x / size : 0.0;
        sy[q] = none ? nan : size > 0.0 ? y / size : 0.0;
        sz[q] = none ? nan : size > 0.0 ? z / size : 0.0;
    }
    double* const points = (double*)out_points.data + 3ll * start;
    double* const normals = (double*)out_normals.data + 3ll * start;
        #pragma clang loop vectorize(disable)
    for (int q = 0; q < count; ++q) {
        out_t.data[start + q] = hit[q];
        points[3 * q] = ox[q];
        points[3 * q + 1] = oy[q];
        points[3 * q + 2] = oz[q];
        normals[3 * q] = sx[q];
        normals[3 * q + 1] = sy[q];
        normals[3 * q + 2] = sz[q];
    }
};
#undef RAY_REALS
#undef RAY_INTS
#undef CUBIC
#undef ENDS
#undef BRACKET
