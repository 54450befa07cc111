// The trilinear interpolant of an adaptive field of floats or its gradient, for up to 64 queries: see sample_kernels.
#include "volume/adaptive/descent.inl"
#include "volume/sampling/trilinear_cpu.inl"

static constexpr auto adaptive_group = [](const AdaptiveLevels& levels, int start, int stop, const auto& points,
                                          const wp::vec3d& origin, const wp::mat33d& to_index, auto& out) {
    const auto table_of = [&](int level) -> const auto& { return levels.tables.data[level]; };
    // Descends for the queries whose cell of level 0 is refined, one by one, before the voxels of all are prefetched.
    const auto descend_all = [&](int* at_x, int* at_y, int* at_z, double* u, double* v, double* w, int* first,
                                 int* last, const float** grids, int* level) {
        const auto& coarsest = table_of(0);
        const unsigned* const words = levels.finer.data + levels.first_word.data[0];
        const int coarse_first = levels.first_entry.data[0];
        const bool alone = levels.tables.shape[0] == 1;
        unsigned long long handed_on = 0;
        for (int q = 0; q < G; ++q) {
            level[q] = 0;
            grids[q] = (const float*)coarsest.grid;
            const bool leaf = (first[q] >= 0) & !alone;
            const int y = at_y[q], word = (at_x[q] & 7) << 1 | (y & 7) >> 2, bit = (y & 3) << 3 | (at_z[q] & 7);
            const unsigned some = words[leaf ? 16ll * ((first[q] - coarse_first) / 67) + word : 0];
            handed_on |= (unsigned long long)(leaf & ((some >> bit) & 1u)) << q;
        }
        for (; handed_on; handed_on &= handed_on - 1) {
            const int n = __builtin_ctzll(handed_on);
            const auto& lower = coarsest.lower;
            const Finest at = descend(levels, at_x[n] + lower[0], at_y[n] + lower[1], at_z[n] + lower[2], u[n], v[n],
                                      w[n], float_step);
            const auto& table = table_of(at.level);
            at_x[n] = at.a;
            at_y[n] = at.b;
            at_z[n] = at.c;
            first[n] = at.entry;
            last[n] = entry_of(entries_of(table), at.a + 1, at.b + 1, at.c + 1);
            grids[n] = (const float*)table.grid;
            level[n] = at.level;
        }
    };
    return answer_group(table_of, start, stop, points, origin, to_index, out, descend_all);
};
