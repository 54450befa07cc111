// Least distances of eight voxels in a row to listed balls, at most the band.
//
// The whole loop is C++, so that eight lanes stay in registers; warp's own vectors go through memory at each step.
// Among balls of equal radius the nearest center decides: this takes one square root per voxel and gives the same
// bits, because the square root is monotone. Expects balls, ball, begin, end, x, y, z, band, slack; returns.
double least[8];
const double start = band + balls.radius.data[0];
for (int k = 0; k < 8; ++k) least[k] = balls.uniform ? start * start : band;
for (int n = begin; n < end; ++n) {
    const int b = ball.data[n];
    const wp::vec_t<3, double>& c = balls.center.data[b];
    const double radius = balls.radius.data[b], dx = x - c[0], dy = y - c[1], dz = z - c[2];
    const double across = dx * dx + dy * dy, reach = band + radius + slack;
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
wp::vec_t<8, double> result;
for (int k = 0; k < 8; ++k) {
    const double distance = balls.uniform ? ::sqrt(least[k]) - balls.radius.data[0] : least[k];
    result[k] = distance < band ? distance : band;
}
return result;
