// The trilinear interpolant of an adaptive field of floats and its gradient, for one query: see sample_kernels.
#include "volume/adaptive/descent.inl"
#include "volume/sampling/trilinear.inl"

// What answer(cell, level) returns for the finest cell around index coordinates of level 0; `none` beyond the box of the
// first table.
static constexpr auto in_finest = [](const AdaptiveLevels& levels, const wp::vec3d& u, auto none, auto answer) {
    const auto& coarsest = levels.tables.data[0];
    const double i0 = floor(u[0]), j0 = floor(u[1]), k0 = floor(u[2]);
    if (!in_box(coarsest, i0 - coarsest.lower[0], j0 - coarsest.lower[1], k0 - coarsest.lower[2])) return none;
    double x = u[0] - i0, y = u[1] - j0, z = u[2] - k0;
    const Finest at = descend(levels, (int)i0, (int)j0, (int)k0, x, y, z, float_step);
    const auto& table = levels.tables.data[at.level];
    return answer(read_cell(table, entries_of(table), at.a, at.b, at.c, at.entry, x, y, z), at.level);
};

static constexpr auto adaptive_value = [](const AdaptiveLevels& levels, const wp::vec3d& u, const wp::mat33d&,
                                          double) -> double {
    return in_finest(levels, u, (double)NAN, [](const Cell& cell, int) { return value_in(cell); });
};
static constexpr auto adaptive_slopes = [](const AdaptiveLevels& levels, const wp::vec3d& u, const wp::mat33d& to_index,
                                           const wp::vec3d&) -> wp::vec3d {
    // A finer level's voxels are smaller by a power of two; its slopes are scaled to the units of level 0.
    return in_finest(levels, u, wp::vec3d((double)NAN),
                     [&](const Cell& cell, int level) { return (double)(1ll << level) * slopes_in(cell, to_index); });
};
