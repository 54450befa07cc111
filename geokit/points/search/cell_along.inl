// The cell of a coordinate on one axis, and the cells of the group that is searched.
#pragma once

// The cell of a coordinate on one axis, clamped to the grid.
//
// The search, the subtraction, the product, the clamp and the truncation are all monotone, rounding included: a
// coordinate between two others gets a cell between theirs. The exactness of a search needs only this property of the
// cells, whatever their sizes.
static constexpr auto cell_along = [](const auto& cells, int axis, double at) -> int {
    int i = cells.first_cut[axis];
    for (int last = cells.last_cut[axis]; i < last;) {
        const int middle = (i + last + 1) / 2;
        if (cells.cut.data[middle][0] <= at) i = middle;
        else last = middle - 1;
    }
    const auto& cut = cells.cut.data[i];
    // Clamped as a float: casting a very large coordinate to int would be undefined.
    const double top = cut[3] - 1.0, cell = (at - cut[0]) * cut[1];
    return (int)(cut[2]) + (int)(cell > 0.0 ? (cell < top ? cell : top) : 0.0);
};

// Puts the fields of a group in place of the grid's own; `entered` is the group whose fields `cells` has.
static constexpr auto enter = [](const auto& grid, int group, auto& cells, int& entered) {
    if (group == entered) return;
    entered = group;
    const auto& own = grid.groups.data[group];
    cells.lower = own.lower;
    cells.upper = own.upper;
    cells.base = own.base;
    cells.first_cut = own.first_cut;
    cells.last_cut = own.last_cut;
    cells.count_x = own.count_x;
    cells.count_y = own.count_y;
};
