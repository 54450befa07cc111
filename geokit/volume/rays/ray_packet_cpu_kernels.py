"""C++ of what all rays of a group do alike, side by side, for raycast_cpu_kernels.

The pieces work on `rays`, an array for each number of a ray, and on `found`, the cells in which a root is bracketed.
Lines in capitals are replaced by other pieces.
"""

# mypy: ignore-errors
import warp as wp

from geokit.volume.rays.raycast_kernels import MOST_ITERATIONS, RESOLUTION, SHORTEST_DIRECTION

__all__ = ["ARRAYS", "BRACKET", "GROUP", "JUMPS", "RAY", "READ", "ROOTS", "WRITE", "lines"]

# Rays of a thread side by side: 8 are 5% slower, 32 no quicker.
GROUP = wp.constant(16)

# What is kept of each ray, and of each cell whose bracket of a root is known.
RAY = {
    "double": "qx qy qz dx dy dz ix iy iz t_first t_last t0 last scale ta".split(),
    "int": "fx fy fz bx by bz crosses entered left clear unseen".split(),
}
BRACKET = "p0 p1 p2 p3 lo hi at_lo at_hi ta tb ex ey ez gx gy gz kx ky kz kxy kxz kyz kxyz".split()


def lines(text, names):
    """C++ with a line for each name."""
    return "".join(f"        {text.replace('NAME', name)}\n" for name in names)


ARRAYS = f"""
    constexpr int G = {int(GROUP)};
    struct Rays {{
{lines("double NAME[G];", RAY["double"])}{lines("int NAME[G];", RAY["int"])}    }} rays;
    struct Brackets {{
        int count, row[G];
{lines("double NAME[G];", BRACKET)}    }} found;
    found.count = 0;
"""

# The rays from `start` on, each with index_ray's operations. Lanes without a ray repeat the first.
READ = """
    const double lower[3] = {field.lower[0], field.lower[1], field.lower[2]};
    const double upper[3] = {field.upper[0], field.upper[1], field.upper[2]};
    const double cx = field.corner[0], cy = field.corner[1], cz = field.corner[2];
    const auto& to_index = field.to_index;
    MATRIX
    const int count = stop - start < G ? stop - start : G;
    double ox[G], oy[G], oz[G], rx[G], ry[G], rz[G];
    ONE_BY_ONE
    for (int q = 0; q < G; ++q) {
        const long long row = start + (q < count ? q : 0);
        const double* const o = (const double*)origins.data + 3 * row;
        const double* const d = (const double*)directions.data + 3 * row;
        ox[q] = o[0]; oy[q] = o[1]; oz[q] = o[2];
        rx[q] = d[0]; ry[q] = d[1]; rz[q] = d[2];
    }
    int useless[G];
    for (int q = 0; q < G; ++q) {
        const double largest = wp::max(wp::max(wp::abs(rx[q]), wp::abs(ry[q])), wp::abs(rz[q]));
        const double lost = ((ox[q] - ox[q]) + (rx[q] - rx[q])) + ((oy[q] - oy[q]) + (ry[q] - ry[q]))
                          + ((oz[q] - oz[q]) + (rz[q] - rz[q]));
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
        SET_UP
        const double ta = 0.0;
        const int clear = -1, unseen = -1;
        KEEP
    }
    int bad = 0;
    for (int q = 0; q < G; ++q) bad |= useless[q];
    if (bad) return 1;
""".replace("SHORTEST_DIRECTION", repr(float(SHORTEST_DIRECTION)))

# The jumps of BLOCK_WALK, four rays at a time, until each is in a block that may hold a crossing (`clear` is 0), or
# through (-1). Vectors of eight would be wider than the registers in which processors run at full speed.
JUMPS = """
    typedef double D4 __attribute__((ext_vector_type(4), aligned(8)));
    typedef int I4 __attribute__((ext_vector_type(4), aligned(4)));
    typedef decltype(D4() < D4()) L4;
    auto narrow = [](L4 mask) { return __builtin_convertvector(mask, I4); };
    auto real = [](I4 number) { return __builtin_convertvector(number, D4); };
    const signed char* const reach = (const signed char*)field.reach.data;
    const int blocks_x = field.first_block[0], blocks_y = field.first_block[1], blocks_z = field.first_block[2];
    const int count_y = field.block_count[1], count_z = field.block_count[2], of_octant = field.reach.shape[0] >> 3;
    int in_block[G];
    for (int q = 0; q < G; q += 4) {
        auto reals = [&](const double* at) { return *(const D4*)(at + q); };
        auto ints = [&](const int* at) { return *(const I4*)(at + q); };
        const D4 qx = reals(rays.qx), qy = reals(rays.qy), qz = reals(rays.qz);
        const D4 dx = reals(rays.dx), dy = reals(rays.dy), dz = reals(rays.dz);
        const D4 ix = reals(rays.ix), iy = reals(rays.iy), iz = reals(rays.iz), last = reals(rays.last);
        // -1 where the ray goes backwards.
        const I4 back_x = ints(rays.fx) - 1, back_y = ints(rays.fy) - 1, back_z = ints(rays.fz) - 1;
        const I4 octant = (back_x * -4 + back_y * -2 - back_z) * of_octant;
        I4 bx = ints(rays.bx), by = ints(rays.by), bz = ints(rays.bz), alive = -ints(rays.crosses);
        I4 unseen = -1, clear, here;
        D4 ta = 0.0;
        for (;;) {
            here = (((bx >> 3) - blocks_x) * count_y + ((by >> 3) - blocks_y)) * count_z + ((bz >> 3) - blocks_z);
            const I4 at = (here + octant) & alive;
            clear = (I4){reach[at[0]], reach[at[1]], reach[at[2]], reach[at[3]]} | ~alive;
            const I4 jumps = clear > 0;
            if (!__builtin_reduce_or(jumps)) break;
            const I4 span = clear * 8;
            auto end_of = [&](I4 b, I4 back) { return (b & ~7) + (back ? 8 - span : span); };
            const I4 ex = end_of(bx, back_x), ey = end_of(by, back_y), ez = end_of(bz, back_z);
            const D4 tx = (real(ex) - qx) * ix, ty = (real(ey) - qy) * iy, tz = (real(ez) - qz) * iz;
            const L4 first_x = (tx <= ty) & (tx <= tz), first_y = ~first_x & (ty <= tz);
            const D4 t = first_x ? tx : first_y ? ty : tz, next = t > ta ? t : ta;
            const I4 along_x = narrow(first_x), along_y = narrow(first_y), along_z = ~(along_x | along_y);
            const I4 stays = jumps & narrow(next <= last);
            auto move = [&](I4 b, I4 along, I4 back, I4 end, D4 from, D4 d) {
                const I4 low = (b & ~7) + (back & (8 - span));
                const D4 above = (from + next * d) - real(low), most = real(span - 1);
                const D4 capped = above < most ? above : most, within = capped > 0.0 ? capped : 0.0;
                return stays ? (along ? end + back : low + __builtin_convertvector(within, I4)) : b;
            };
            bx = move(bx, along_x, back_x, ex, qx, dx);
            by = move(by, along_y, back_y, ey, qy, dy);
            bz = move(bz, along_z, back_z, ez, qz, dz);
            ta = __builtin_convertvector(jumps, L4) ? next : ta;
            unseen = jumps ? (along_x ? back_x * -4 : along_y ? back_y * -2 : -back_z) : unseen;
            alive &= stays | ~jumps;
        }
        *(I4*)(rays.bx + q) = bx;
        *(I4*)(rays.by + q) = by;
        *(I4*)(rays.bz + q) = bz;
        *(I4*)(rays.clear + q) = clear;
        *(I4*)(rays.unseen + q) = unseen;
        *(D4*)(rays.ta + q) = ta;
        *(I4*)(in_block + q) = here & (clear == 0);
    }
    ONE_BY_ONE
    for (int q = 0; q < G; ++q) {
        const auto* const block = field.blocks.data + BLOCK_WORDS * (long long)field.numbers.data[in_block[q]];
        __builtin_prefetch(block);
        __builtin_prefetch(block + 8);
    }
"""

# ON_CELL's steps to the root, eight cells side by side; the last ones repeat the first.
ROOTS = """
    for (int n = found.count; n < ((found.count + 7) & ~7); ++n) {
        found.row[n] = found.row[0];
        REPEAT
    }
    for (int base = 0; base < found.count; base += 8) {
        double s[8], left_end[8], right_end[8], moved[8];
        int going[8];
        for (int n = 0; n < 8; ++n) {
            const double lo = found.lo[base + n], hi = found.hi[base + n], at_lo = found.at_lo[base + n];
            s[n] = lo + (hi - lo) * (at_lo / (at_lo - found.at_hi[base + n]));
            left_end[n] = lo; right_end[n] = hi;
            moved[n] = hi - lo;
            going[n] = 1;
        }
        for (int round = 0; round < MOST_ITERATIONS; ++round) {
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
                left_end[n] = left; right_end[n] = right;
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
        ONE_BY_ONE
        for (int n = 0; n < 8; ++n) {
            const int q = found.row[base + n];
            hit[q] = rays.t0[q] + t[n];
            sx[q] = x[n]; sy[q] = y[n]; sz[q] = z[n];
        }
    }
""".replace("MOST_ITERATIONS", str(MOST_ITERATIONS)).replace("RESOLUTION", str(RESOLUTION))

# write_hit's operations.
WRITE = """
    for (int q = 0; q < G; ++q) {
        const bool none = hit[q] == (double)INFINITY;
        const double t = hit[q] / rays.scale[q], nan = (double)NAN;
        const double x = m00 * sx[q] + m10 * sy[q] + m20 * sz[q], y = m01 * sx[q] + m11 * sy[q] + m21 * sz[q];
        const double z = m02 * sx[q] + m12 * sy[q] + m22 * sz[q];
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
    ONE_BY_ONE
    for (int q = 0; q < count; ++q) {
        out_t.data[start + q] = hit[q];
        points[3 * q] = ox[q]; points[3 * q + 1] = oy[q]; points[3 * q + 2] = oz[q];
        normals[3 * q] = sx[q]; normals[3 * q + 1] = sy[q]; normals[3 * q + 2] = sz[q];
    }
    return 0;
"""
