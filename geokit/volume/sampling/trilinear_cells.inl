// The trilinear interpolant of a float grid, or its gradient, through the grid's leaf table: for one query, or on a
// CPU for up to 64 queries in SIMD. Fields of one level (trilinear_table_kernels) and of several
// (adaptive/sample_kernels) share this text, so their sums agree to the last bit.
//
// Expects to_index and FIRST_TABLE, a macro for the LeafTable (of level 0); the macro GRADIENT, 0, 1, or 2 for both (of
// one level, for one query); and
// - for one query: u, its index coordinates. Returns a double, a wp::vec_t of three, or one of four, the value first;
//   NaN beyond the table's box.
// - for many: the macro REAL, the type of points and answers; start, stop, points, origin, out. Returns a bit mask of
//   the queries beyond the table's box, which the caller must answer through the tree.
// Fields of several levels define the hooks DESCENT and GROUP_DESCENT, which go from the cell of level 0 to the cell
// that answers, and LEVEL_TABLE(level), the table of a level.
#include "volume/sampling/table_look_up.inl"
#if defined(REAL) && defined(__CUDA_ARCH__)
return 0ull;
#else
// The box of the table: its first voxel, and the lowest voxel of its last cell.
const auto& coarsest = FIRST_TABLE;
const int lower_x = coarsest.lower[0], lower_y = coarsest.lower[1], lower_z = coarsest.lower[2];
const int last_x = coarsest.size[0] * 128 - 2, last_y = coarsest.size[1] * 128 - 2;
const int last_z = coarsest.size[2] * 128 - 2;
#include "volume/sampling/matrix.inl"
#endif

#if defined(REAL) && !defined(__CUDA_ARCH__)
TREE_OF(coarsest)
constexpr int G = 64;
const double origin_x = origin[0], origin_y = origin[1], origin_z = origin[2];
const REAL* const rows = (const REAL*)points.data;
const int count = stop - start < G ? stop - start : G;
double u[G], v[G], w[G];
    // Vectorization is off for loops with scattered reads: compilers emit gather instructions, which take several
    // times as long as loads on processors with the microcode mitigation (Intel's before 2023).
    #pragma clang loop vectorize(disable)
for (int q = 0; q < G; ++q) {
    const REAL* const p = rows + 3ll * (start + (q < count ? q : 0));
    u[q] = (double)p[0];
    v[q] = (double)p[1];
    w[q] = (double)p[2];
}
// Voxels relative to the box, fractions (u, v, w), and whether the query lies outside the box.
int at_x[G], at_y[G], at_z[G], outside[G];
for (int q = 0; q < G; ++q) {
    const double x = u[q] - origin_x, y = v[q] - origin_y, z = w[q] - origin_z;
    const double a = m00 * x + m01 * y + m02 * z, b = m10 * x + m11 * y + m12 * z, c = m20 * x + m21 * y + m22 * z;
    const double i0 = __builtin_floor(a), j0 = __builtin_floor(b), k0 = __builtin_floor(c);
    u[q] = a - i0;
    v[q] = b - j0;
    w[q] = c - k0;
    const double i1 = i0 - lower_x, j1 = j0 - lower_y, k1 = k0 - lower_z;
    // False for NaN as well.
    const bool inside = (i1 >= 0.0) & (i1 <= last_x) & (j1 >= 0.0) & (j1 <= last_y) & (k1 >= 0.0) & (k1 <= last_z);
    outside[q] = !inside;
    at_x[q] = inside ? (int)i1 : 0;
    at_y[q] = inside ? (int)j1 : 0;
    at_z[q] = inside ? (int)k1 : 0;
}
// Entries of each cell's first and last voxel.
int first_top[G], first_slot[G], last_top[G], last_slot[G];
for (int q = 0; q < G; ++q) {
    const int x = at_x[q], y = at_y[q], z = at_z[q], x1 = x + 1, y1 = y + 1, z1 = z + 1;
    first_top[q] = UPPER_OF(x, y, z);
    first_slot[q] = SLOT_OF(x, y, z);
    last_top[q] = UPPER_OF(x1, y1, z1);
    last_slot[q] = SLOT_OF(x1, y1, z1);
}
int first[G], last[G];
    #pragma clang loop vectorize(disable)
for (int q = 0; q < G; ++q) {
    const int a = top[first_top[q]], b = top[last_top[q]];
    first[q] = a < 0 ? a : slots[a + first_slot[q]];
    last[q] = b < 0 ? b : slots[b + last_slot[q]];
}
#ifdef GROUP_DESCENT
#include GROUP_DESCENT
#define VOXELS voxels[q]
#else
const float* const voxels = (const float*)coarsest.grid;
#define VOXELS voxels
#endif
// The place of each cell's first voxel relative to `voxels`, and the steps from it to the next voxel along each
// axis. Where a cell crosses one leaf border, the step along that axis jumps from one leaf into the other.
long long at[G], step_x[G], step_y[G], step_z[G];
int apart[G];
for (int q = 0; q < G; ++q) {
    const int x = at_x[q] & 7, y = at_y[q] & 7, z = at_z[q] & 7;
    const int borders = (x == 7) + (y == 7) + (z == 7);
    const long long leaf = (long long)first[q] * 8, jump = (long long)last[q] * 8 - leaf;
    const bool tile = first[q] < 0;
    apart[q] = (borders > 1) | ((borders == 1) & (tile | (last[q] < 0)));
    at[q] = tile ? (long long)~first[q] : leaf + 24 + (x << 6 | y << 3 | z);
    step_x[q] = tile ? 0 : x == 7 ? jump - 448 : 64;
    step_y[q] = tile ? 0 : y == 7 ? jump - 56 : 8;
    step_z[q] = tile ? 0 : z == 7 ? jump - 7 : 1;
}
unsigned long long left = 0;
for (int q = 0; q < G; ++q) {
    left |= (unsigned long long)(outside[q] != 0) << q;
    const float* const near = VOXELS + at[q];
    const float* const far = apart[q] ? near : near + step_x[q];
    const long long up = apart[q] ? 0 : step_y[q];
    __builtin_prefetch(near);
    __builtin_prefetch(near + up);
    __builtin_prefetch(far);
    __builtin_prefetch(far + up);
}
float cell[8][G];
for (int q = 0; q < G; ++q) {
    if (!apart[q]) {
        const float* c = VOXELS + at[q];
        const long long y = step_y[q], z = step_z[q];
        cell[0][q] = c[0];
        cell[1][q] = c[z];
        cell[2][q] = c[y];
        cell[3][q] = c[y + z];
        c += step_x[q];
        cell[4][q] = c[0];
        cell[5][q] = c[z];
        cell[6][q] = c[y];
        cell[7][q] = c[y + z];
    } else {
        // The cell crosses two borders or more, or one border beside a tile: each voxel has a look-up of its own.
#ifdef GROUP_DESCENT
        TREE_OF(LEVEL_TABLE(level_of[q]))
#endif
            #pragma clang loop vectorize(disable)
        for (int n = 0; n < 8; ++n) {
            const int x = at_x[q] + (n >> 2), y = at_y[q] + ((n >> 1) & 1), z = at_z[q] + (n & 1);
            FIND_ENTRY(x, y, z)
            const long long place =
                entry < 0 ? (long long)~entry : (long long)entry * 8 + 24 + ((x & 7) << 6 | (y & 7) << 3 | (z & 7));
            cell[n][q] = VOXELS[place];
        }
    }
}
#if GRADIENT
double r0[G], r1[G], r2[G];
#else
double r[G];
#endif
for (int q = 0; q < G; ++q) {
    const double x = u[q], y = v[q], z = w[q];
    const double c0 = cell[0][q], c1 = cell[1][q], c2 = cell[2][q], c3 = cell[3][q];
    const double c4 = cell[4][q], c5 = cell[5][q], c6 = cell[6][q], c7 = cell[7][q];
#include "volume/sampling/trilinear_sums.inl"
#if !GRADIENT
    r[q] = value;
#elif defined(GROUP_DESCENT)
    // A finer level's voxels are smaller by a power of two; its slopes are scaled to the units of level 0.
    const double s = (double)(1ll << level_of[q]);
    r0[q] = s * g0;
    r1[q] = s * g1;
    r2[q] = s * g2;
#else
    r0[q] = g0;
    r1[q] = g1;
    r2[q] = g2;
#endif
}
REAL* const results = (REAL*)out.data;
for (int q = 0; q < count; ++q) {
#if GRADIENT
    auto* const g = results + 3ll * (start + q);
    g[0] = r0[q];
    g[1] = r1[q];
    g[2] = r2[q];
#else
    results[start + q] = r[q];
#endif
}
return count == G ? left : left & ((1ull << count) - 1ull);
#undef VOXELS
#endif

#if !defined(REAL)
const double i0 = floor(u[0]), j0 = floor(u[1]), k0 = floor(u[2]);
const double i1 = i0 - lower_x, j1 = j0 - lower_y, k1 = k0 - lower_z;
if (!(i1 >= 0.0 && i1 <= last_x && j1 >= 0.0 && j1 <= last_y && k1 >= 0.0 && k1 <= last_z)) {
#if GRADIENT == 2
    return wp::vec_t<4, double>((double)NAN);
#elif GRADIENT
    return wp::vec_t<3, double>((double)NAN);
#else
    return (double)NAN;
#endif
}
#ifdef DESCENT
int i = (int)i0, j = (int)j0, k = (int)k0;
double x = u[0] - i0, y = u[1] - j0, z = u[2] - k0;
#include DESCENT
const auto& finest = LEVEL_TABLE(level);
#else
const int a = (int)i1, b = (int)j1, c = (int)k1;
const double x = u[0] - i0, y = u[1] - j0, z = u[2] - k0;
const auto& finest = coarsest;
#endif
const float* const voxels = (const float*)finest.grid;
TREE_OF(finest)
const auto entry_of = [&](int f, int g, int h) {
    FIND_ENTRY(f, g, h)
    return entry;
};
#ifndef DESCENT
const int e000 = entry_of(a, b, c);
#endif
double c0, c1, c2, c3, c4, c5, c6, c7;
if (e000 >= 0 && finest.pairs.data) {
    struct alignas(8) Pair {
        float low, high;
    };
    const Pair* const p =
        (const Pair*)finest.pairs.data
        + ((long long)((e000 - finest.first_leaf) / 67) * 648 + (((a & 7) * 8 + (b & 7)) * 9 + (c & 7)));
    const Pair near_0 = p[0], near_1 = p[1], far_0 = p[72], far_1 = p[73];
    c0 = (double)near_0.low;
    c1 = (double)near_1.low;
    c2 = (double)near_0.high;
    c3 = (double)near_1.high;
    c4 = (double)far_0.low;
    c5 = (double)far_1.low;
    c6 = (double)far_0.high;
    c7 = (double)far_1.high;
} else {
    // Only the leaves that the cell reaches into are looked up.
    const bool next_x = (a & 7) == 7, next_y = (b & 7) == 7, next_z = (c & 7) == 7;
    const int e001 = next_z ? entry_of(a, b, c + 1) : e000;
    const int e010 = next_y ? entry_of(a, b + 1, c) : e000;
    const int e100 = next_x ? entry_of(a + 1, b, c) : e000;
    const int e011 = !next_y ? e001 : next_z ? entry_of(a, b + 1, c + 1) : e010;
    const int e101 = !next_x ? e001 : next_z ? entry_of(a + 1, b, c + 1) : e100;
    const int e110 = !next_x ? e010 : next_y ? entry_of(a + 1, b + 1, c) : e100;
    const int e111 = !next_x ? e011 : !next_y ? e101 : next_z ? entry_of(a + 1, b + 1, c + 1) : e110;
    const auto voxel = [&](int entry, int n) {
        return (double)voxels[entry < 0 ? (long long)~entry : (long long)entry * 8 + 24 + n];
    };
    const int x0 = (a & 7) << 6, x1 = ((a + 1) & 7) << 6;
    const int y0 = (b & 7) << 3, y1 = ((b + 1) & 7) << 3;
    const int z0 = c & 7, z1 = (c + 1) & 7;
    c0 = voxel(e000, x0 | y0 | z0);
    c1 = voxel(e001, x0 | y0 | z1);
    c2 = voxel(e010, x0 | y1 | z0);
    c3 = voxel(e011, x0 | y1 | z1);
    c4 = voxel(e100, x1 | y0 | z0);
    c5 = voxel(e101, x1 | y0 | z1);
    c6 = voxel(e110, x1 | y1 | z0);
    c7 = voxel(e111, x1 | y1 | z1);
}
#include "volume/sampling/trilinear_sums.inl"
#if !GRADIENT
return value;
#elif GRADIENT == 2
return wp::vec_t<4, double>(value, g0, g1, g2);
#elif defined(DESCENT)
const double s = (double)(1ll << level);
return wp::vec_t<3, double>(s * g0, s* g1, s* g2);
#else
return wp::vec_t<3, double>(g0, g1, g2);
#endif
#endif
#undef UPPER_OF
#undef SLOT_OF
#undef TREE_OF
#undef FIND_ENTRY
