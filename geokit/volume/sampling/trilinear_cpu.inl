// The trilinear interpolant or its gradient for up to 64 queries in SIMD: see trilinear_table_kernels.
#include "volume/sampling/trilinear.inl"

constexpr int G = 64;

// Answers the points `start` to `stop`: gradients where answers have as many numbers as points. Returns a bit mask of
// the queries beyond the table's box, which the caller must answer through the tree. For fields of several levels
// table_of is the table of a level, and descend goes from the cells of level 0 to those that answer; for one level it is
// nullptr.
static constexpr auto answer_group = [](auto table_of, int start, int stop, const auto& points, const wp::vec3d& origin,
                                        const wp::mat33d& to_index, auto& out, auto descend) -> unsigned long long {
    constexpr bool several = !__is_same(decltype(descend), decltype(nullptr));
    constexpr bool gradient = sizeof(*out.data) == sizeof(*points.data);
    typedef decltype(points.data[0][0] + points.data[0][0]) Real;
    const auto& coarsest = table_of(0);
    // The box of the table: its first voxel, and the lowest voxel of its last cell.
    const int lower_x = coarsest.lower[0], lower_y = coarsest.lower[1], lower_z = coarsest.lower[2];
    const int last_x = coarsest.size[0] * 128 - 2, last_y = coarsest.size[1] * 128 - 2;
    const int last_z = coarsest.size[2] * 128 - 2;
    const wp::mat33d matrix = to_index;
    const auto& m = matrix.data;
    const Entries entries = entries_of(coarsest);
    const double origin_x = origin[0], origin_y = origin[1], origin_z = origin[2];
    const Real* const rows = (const Real*)points.data;
    const int count = stop - start < G ? stop - start : G;
    double u[G], v[G], w[G];
    // Vectorization is off for loops with scattered reads: compilers emit gather instructions, which take several
    // times as long as loads on processors with the microcode mitigation (Intel's before 2023).
    #pragma clang loop vectorize(disable)
    for (int q = 0; q < G; ++q) {
        const Real* const p = rows + 3ll * (start + (q < count ? q : 0));
        u[q] = (double)p[0];
        v[q] = (double)p[1];
        w[q] = (double)p[2];
    }
    // Voxels relative to the box, fractions (u, v, w), and whether the query lies outside the box.
    int at_x[G], at_y[G], at_z[G], outside[G];
    for (int q = 0; q < G; ++q) {
        const double x = u[q] - origin_x, y = v[q] - origin_y, z = w[q] - origin_z;
        const double a = m[0][0] * x + m[0][1] * y + m[0][2] * z, b = m[1][0] * x + m[1][1] * y + m[1][2] * z;
        const double c = m[2][0] * x + m[2][1] * y + m[2][2] * z;
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
        const int x = at_x[q], y = at_y[q], z = at_z[q];
        first_top[q] = upper_of(entries, x, y, z);
        first_slot[q] = slot_of(x, y, z);
        last_top[q] = upper_of(entries, x + 1, y + 1, z + 1);
        last_slot[q] = slot_of(x + 1, y + 1, z + 1);
    }
    int first[G], last[G];
    #pragma clang loop vectorize(disable)
    for (int q = 0; q < G; ++q) {
        const int a = entries.top[first_top[q]], b = entries.top[last_top[q]];
        first[q] = a < 0 ? a : entries.slots[a + first_slot[q]];
        last[q] = b < 0 ? b : entries.slots[b + last_slot[q]];
    }
    // The voxels of each query's level, and the level.
    const float* grids[several ? G : 1];
    int level[several ? G : 1];
    grids[0] = (const float*)coarsest.grid;
    if constexpr (several) descend(at_x, at_y, at_z, u, v, w, first, last, grids, level);
    const auto voxels = [&](int q) { return grids[several ? q : 0]; };
    // The place of each cell's first voxel in these, and the steps from it to the next voxel along each axis. Where a
    // cell crosses one leaf border, the step along that axis jumps from one leaf into the other.
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
        const float* const near = voxels(q) + at[q];
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
            const float* c = voxels(q) + at[q];
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
            const Entries own = several ? entries_of(table_of(level[several ? q : 0])) : entries;
            #pragma clang loop vectorize(disable)
            for (int n = 0; n < 8; ++n) {
                const int x = at_x[q] + (n >> 2), y = at_y[q] + ((n >> 1) & 1), z = at_z[q] + (n & 1);
                cell[n][q] = voxels(q)[place_of(entry_of(own, x, y, z), x, y, z)];
            }
        }
    }
    double r[gradient ? 3 : 1][G];
    for (int q = 0; q < G; ++q) {
        const Cell c = {cell[0][q], cell[1][q], cell[2][q], cell[3][q], cell[4][q], cell[5][q],
                        cell[6][q], cell[7][q], u[q],       v[q],       w[q]};
        if constexpr (gradient) {
            const wp::vec3d slopes = slopes_in(c, matrix);
            // A finer level's voxels are smaller by a power of two; its slopes are scaled to the units of level 0.
            const double s = several ? (double)(1ll << level[several ? q : 0]) : 1.0;
            for (int axis = 0; axis < 3; ++axis) r[axis][q] = several ? s * slopes[axis] : slopes[axis];
        } else {
            r[0][q] = value_in(c);
        }
    }
    Real* const results = (Real*)out.data;
    constexpr int numbers = gradient ? 3 : 1;
    for (int q = 0; q < count; ++q)
        for (int axis = 0; axis < numbers; ++axis) results[(long long)numbers * (start + q) + axis] = r[axis][q];
    return count == G ? left : left & ((1ull << count) - 1ull);
};

// The queries of a field of one level.
static constexpr auto interpolate_group = [](const auto& table, int start, int stop, const auto& points,
                                             const wp::vec3d& origin, const wp::mat33d& to_index, auto& out) {
    const auto table_of = [&](int) -> const auto& { return table; };
    return answer_group(table_of, start, stop, points, origin, to_index, out, nullptr);
};
