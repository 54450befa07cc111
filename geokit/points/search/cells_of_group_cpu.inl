// The cells of the group that is searched, or of all points where there are no groups.
//
// Expects grid. Defines cells, the grid with the fields of a group in place of its own, and enter(group).

auto cells = grid;
int entered = -1;
auto enter = [&](int group) {
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
