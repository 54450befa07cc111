// The cell of a coordinate along an axis, equal to the result of cell_along in cells_kernels.
//
// Expects cells. Defines cell_along(axis, at).

auto cell_along = [&](int axis, double at) -> int {
    int i = cells.first_cut[axis];
    for (int last = cells.last_cut[axis]; i < last;) {
        const int middle = (i + last + 1) / 2;
        if (cells.cut.data[middle][0] <= at) i = middle;
        else last = middle - 1;
    }
    const auto& cut = cells.cut.data[i];
    const double top = cut[3] - 1.0, cell = (at - cut[0]) * cut[1];
    return (int)(cut[2]) + (int)(cell > 0.0 ? (cell < top ? cell : top) : 0.0);
};
