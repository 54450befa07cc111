// The crossing of an edge of the grid, in world coordinates.
//
// Expects linear, offset, END. Defines point_on(first, x, bit, axis, f, g).

constexpr float least_place = (float)END, most_place = 1.f - least_place;
// The crossing of the edge along an axis from a cell's lowest corner, whose ends have the values f and g.
auto point_on = [&](const wp::vec_t<3, int>& first, int x, int bit, int axis, float f, float g) {
    const float t = f / (f - g);
    // The comparisons turn NaN into a number.
    const float end = t > least_place ? t : least_place, inner = end < most_place ? end : most_place;
    double index[3] = {(double)(first[0] + x), (double)(first[1] + (bit >> 3)), (double)(first[2] + (bit & 7))};
    index[axis] += (double)inner;
    wp::vec_t<3, double> point;
    for (int row = 0; row < 3; ++row) {
        point[row] = linear.data[row][0] * index[0] + linear.data[row][1] * index[1] + linear.data[row][2] * index[2]
                     + offset[row];
    }
    return point;
};
