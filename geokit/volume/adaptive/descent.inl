// Descends from the cell of level 0 around a point to the finest cell that contains it. While a cell's bit says that it
// is refined, the next cell is the one of its halves that contains the point.
#pragma once
#include "volume/sampling/leaf_table.inl"

// A cell's level, its place in the box of the level's table, and the entry of its first voxel there.
struct Finest {
    int level, a, b, c, entry;
};

// From the cell (i, j, k) of level 0; x, y, z, the point's fractions in it, become those in the finest cell. step_of is
// how far the entries of two leaves of a level are apart at least.
static constexpr auto descend = [](const AdaptiveLevels& levels, int i, int j, int k, double& x, double& y, double& z,
                                   auto step_of) -> Finest {
    Finest at = {};
    for (;; ++at.level) {
        const int level = at.level;
        const auto& table = levels.tables.data[level];
        const int a = at.a = i - table.lower[0], b = at.b = j - table.lower[1], c = at.c = k - table.lower[2];
        const int entry = at.entry = entry_of(entries_of(table), a, b, c);
        if (entry < 0 || level + 1 == levels.tables.shape[0]) break;
        const unsigned bits =
            levels.finer
                .data[levels.first_word.data[level] + 16ll * ((entry - levels.first_entry.data[level]) / step_of(level))
                      + ((a & 7) << 1 | (b & 7) >> 2)];
        if (!((bits >> ((b & 3) << 3 | (c & 7))) & 1u)) break;
        const int p = x >= 0.5, q = y >= 0.5, r = z >= 0.5;
        const auto& moved = levels.shift.data[level];
        i = 2 * i + moved[0] + p;
        j = 2 * j + moved[1] + q;
        k = 2 * k + moved[2] + r;
        // Doubling is exact.
        x = 2.0 * x - p;
        y = 2.0 * y - q;
        z = 2.0 * z - r;
    }
    return at;
};

// Leaves of float grids have 67 times 32 bytes.
static constexpr auto float_step = [](int) -> int { return 67; };

// The level, and the first voxel, of the finest cell around index coordinates of level 0 within int32, for fields of any
// order and codec. A point beyond the box of the first table belongs to level 0.
static constexpr auto find_finest = [](const AdaptiveLevels& levels, const wp::vec3d& u) -> wp::vec4i {
    const double i0 = floor(u[0]), j0 = floor(u[1]), k0 = floor(u[2]);
    const int i = (int)i0, j = (int)j0, k = (int)k0;
    const auto& coarsest = levels.tables.data[0];
    const double i1 = i0 - coarsest.lower[0], j1 = j0 - coarsest.lower[1], k1 = k0 - coarsest.lower[2];
    if (!(i1 >= 0.0 && i1 < coarsest.size[0] * 128.0 && j1 >= 0.0 && j1 < coarsest.size[1] * 128.0 && k1 >= 0.0
          && k1 < coarsest.size[2] * 128.0))
        return wp::vec4i(0, i, j, k);
    double x = u[0] - i0, y = u[1] - j0, z = u[2] - k0;
    const Finest at = descend(levels, i, j, k, x, y, z, [&](int level) { return levels.step.data[level]; });
    const auto& lower = levels.tables.data[at.level].lower;
    return wp::vec4i(at.level, at.a + lower[0], at.b + lower[1], at.c + lower[2]);
};
