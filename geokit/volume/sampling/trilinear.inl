// The trilinear interpolant of a float grid and its gradient, through the grid's leaf table. Fields of one level
// (trilinear_table_kernels) and of several (adaptive/sample_kernels) share it, so their sums agree to the last bit.
#pragma once
#include "volume/sampling/leaf_table.inl"

// A cell's voxels, k fastest, and a point's fractions in it. sample_kernels has the same sums for grids without a table;
// the answers agree to the last bit and must stay so.
struct Cell {
    double c0, c1, c2, c3, c4, c5, c6, c7, x, y, z;
};
static constexpr auto value_in = [](const Cell& cell) -> double {
    const auto [c0, c1, c2, c3, c4, c5, c6, c7, x, y, z] = cell;
    const double low_low = c0 + (c1 - c0) * z, low_high = c2 + (c3 - c2) * z;
    const double high_low = c4 + (c5 - c4) * z, high_high = c6 + (c7 - c6) * z;
    const double low = low_low + (low_high - low_low) * y, high = high_low + (high_high - high_low) * y;
    return low + (high - low) * x;
};
static constexpr auto slopes_in = [](const Cell& cell, const wp::mat33d& to_index) -> wp::vec3d {
    const auto [c0, c1, c2, c3, c4, c5, c6, c7, x, y, z] = cell;
    // Differences come before averages, as in trilinear_slopes.
    const double i_low = (c4 - c0) + ((c5 - c1) - (c4 - c0)) * z, i_high = (c6 - c2) + ((c7 - c3) - (c6 - c2)) * z;
    const double j_low = (c2 - c0) + ((c3 - c1) - (c2 - c0)) * z, j_high = (c6 - c4) + ((c7 - c5) - (c6 - c4)) * z;
    const double k_low = (c1 - c0) + ((c3 - c2) - (c1 - c0)) * y, k_high = (c5 - c4) + ((c7 - c6) - (c5 - c4)) * y;
    const double di = i_low + (i_high - i_low) * y;
    const double dj = j_low + (j_high - j_low) * x;
    const double dk = k_low + (k_high - k_low) * x;
    const auto& m = to_index.data;
    return wp::vec3d(di * m[0][0] + dj * m[1][0] + dk * m[2][0], di * m[0][1] + dj * m[1][1] + dk * m[2][1],
                     di * m[0][2] + dj * m[1][2] + dk * m[2][2]);
};

// Whether a cell, relative to the box of a table, lies in it; not if it is NaN.
static constexpr auto in_box = [](const auto& table, double i, double j, double k) -> bool {
    const int last_x = table.size[0] * 128 - 2, last_y = table.size[1] * 128 - 2, last_z = table.size[2] * 128 - 2;
    return i >= 0.0 && i <= last_x && j >= 0.0 && j <= last_y && k >= 0.0 && k <= last_z;
};

// The cell (a, b, c), relative to the box of its table; e000 is the entry of its first voxel.
static constexpr auto read_cell = [](const auto& table, const Entries& entries, int a, int b, int c, int e000, double x,
                                     double y, double z) -> Cell {
    if (e000 >= 0 && table.pairs.data) {
        struct alignas(8) Pair {
            float low, high;
        };
        const Pair* const p =
            (const Pair*)table.pairs.data
            + ((long long)((e000 - table.first_leaf) / 67) * 648 + (((a & 7) * 8 + (b & 7)) * 9 + (c & 7)));
        const Pair near_0 = p[0], near_1 = p[1], far_0 = p[72], far_1 = p[73];
        return {near_0.low, near_1.low, near_0.high, near_1.high, far_0.low, far_1.low,
                far_0.high, far_1.high, x,           y,           z};
    }
    // Only the leaves that the cell reaches into are looked up.
    const bool next_x = (a & 7) == 7, next_y = (b & 7) == 7, next_z = (c & 7) == 7;
    const int e001 = next_z ? entry_of(entries, a, b, c + 1) : e000;
    const int e010 = next_y ? entry_of(entries, a, b + 1, c) : e000;
    const int e100 = next_x ? entry_of(entries, a + 1, b, c) : e000;
    const int e011 = !next_y ? e001 : next_z ? entry_of(entries, a, b + 1, c + 1) : e010;
    const int e101 = !next_x ? e001 : next_z ? entry_of(entries, a + 1, b, c + 1) : e100;
    const int e110 = !next_x ? e010 : next_y ? entry_of(entries, a + 1, b + 1, c) : e100;
    const int e111 = !next_x ? e011 : !next_y ? e101 : next_z ? entry_of(entries, a + 1, b + 1, c + 1) : e110;
    const auto voxel = [&](int entry, int f, int g, int h) {
        return ((const float*)table.grid)[place_of(entry, f, g, h)];
    };
    const float c0 = voxel(e000, a, b, c), c1 = voxel(e001, a, b, c + 1);
    const float c2 = voxel(e010, a, b + 1, c), c3 = voxel(e011, a, b + 1, c + 1);
    const float c4 = voxel(e100, a + 1, b, c), c5 = voxel(e101, a + 1, b, c + 1);
    const float c6 = voxel(e110, a + 1, b + 1, c), c7 = voxel(e111, a + 1, b + 1, c + 1);
    return {c0, c1, c2, c3, c4, c5, c6, c7, x, y, z};
};

// What answer(cell) returns for the cell around index coordinates; `none` beyond the table's box.
static constexpr auto in_cell = [](const auto& table, const wp::vec3d& u, auto none, auto answer) {
    const double i0 = floor(u[0]), j0 = floor(u[1]), k0 = floor(u[2]);
    const double i1 = i0 - table.lower[0], j1 = j0 - table.lower[1], k1 = k0 - table.lower[2];
    if (!in_box(table, i1, j1, k1)) return none;
    const Entries entries = entries_of(table);
    const int a = (int)i1, b = (int)j1, c = (int)k1;
    return answer(read_cell(table, entries, a, b, c, entry_of(entries, a, b, c), u[0] - i0, u[1] - j0, u[2] - k0));
};

static constexpr auto table_value = [](const auto& table, const wp::vec3d& u, const wp::mat33d&, double) -> double {
    return in_cell(table, u, (double)NAN, [](const Cell& cell) { return value_in(cell); });
};
static constexpr auto table_slopes = [](const auto& table, const wp::vec3d& u, const wp::mat33d& to_index,
                                        const wp::vec3d&) -> wp::vec3d {
    return in_cell(table, u, wp::vec3d((double)NAN), [&](const Cell& cell) { return slopes_in(cell, to_index); });
};
static constexpr auto value_and_slopes = [](const auto& table, const wp::vec3d& u,
                                            const wp::mat33d& to_index) -> wp::vec4d {
    return in_cell(table, u, wp::vec4d((double)NAN), [&](const Cell& cell) {
        const wp::vec3d slopes = slopes_in(cell, to_index);
        return wp::vec4d(value_in(cell), slopes[0], slopes[1], slopes[2]);
    });
};
