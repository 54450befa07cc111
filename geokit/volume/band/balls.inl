// Least distances of a row of eight voxels to the balls in its tile's list, at most the band.
//
// The whole loop is C++, so that eight lanes stay in registers; warp's own vectors go through memory at each step.
// Among balls of equal radius the nearest center decides: this takes one square root per voxel and gives the same
// bits, because the square root is monotone.
static constexpr auto least_distances = [](int item, const Balls& balls, const wp::array_t<wp::vec3i>& corners,
                                           const wp::array_t<int>& ends, const wp::array_t<int>& ball, double band,
                                           auto& out_distance) {
    const int tile = item >> 6, row = item & 63, end = ends.data[tile];
    const wp::vec3i& corner = corners.data[tile];
    const double x = corner[0] + (row >> 3), y = corner[1] + (row & 7), z = corner[2];
    double least[8];
    const double start = band + balls.radius.data[0];
    for (int k = 0; k < 8; ++k) least[k] = balls.uniform ? start * start : band;
    for (int n = tile ? ends.data[tile - 1] : 0; n < end; ++n) {
        const int b = ball.data[n];
        const wp::vec_t<3, double>& c = balls.center.data[b];
        const double radius = balls.radius.data[b], dx = x - c[0], dy = y - c[1], dz = z - c[2];
        const double across = dx * dx + dy * dy, reach = band + radius + SLACK;
        if (across >= reach * reach) continue;
        if (balls.uniform) {
            for (int k = 0; k < 8; ++k) {
                const double along = dz + (double)k, squared = across + along * along;
                least[k] = squared < least[k] ? squared : least[k];
            }
        } else {
            for (int k = 0; k < 8; ++k) {
                const double along = dz + (double)k, distance = ::sqrt(across + along * along) - radius;
                least[k] = distance < least[k] ? distance : least[k];
            }
        }
    }
    for (int k = 0; k < 8; ++k) {
        const double distance = balls.uniform ? ::sqrt(least[k]) - balls.radius.data[0] : least[k];
        out_distance.data[item][k] = distance < band ? distance : band;
    }
};
