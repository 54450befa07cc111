// Finds the first crossing of the isovalue in a cell; hook ON_CELL of traverse.inl. Between the roots of its
// derivative the cubic is monotone, so a change of sign there brackets exactly one root.
//
// Expects the names of traverse.inl and raycast_start.inl; isovalue; the constants ROUNDS and RESOLUTION; the macros
// FLOAT_GRID and SIDE_BY_SIDE: 1 if ray_roots_cpu.inl iterates to the root, provided that no value or slope of the
// cubic overflows (LARGEST_SUM). Ends the walk by a goto to `done`.
if (unseen >= 0) side = c[unseen] > (real)below ? 1 : -1;
bool over = !mixed, under = !mixed;
for (int m = 0; m < 8; ++m) {
    over = over & (c[m] > (real)below);
    under = under & (c[m] < (real)above);
}
const int now = over ? 1 : under ? -1 : 0;
if (now == 0 || now * side < 0) {
#if FLOAT_GRID
#define VOXEL(n) (double)c[n]
#else
    // If squares overflow or underflow in double, the cubic's turning points are lost. Such cells are scaled
    // by a power of two, which rounds nothing. Squares of float32 numbers are far from these limits.
    double unit = 1.0;
    {
        double most = wp::abs(isovalue);
        for (int m = 0; m < 8; ++m) most = wp::max(most, wp::abs((double)c[m]));
        if (most > 1e140) unit = 0x1p-600;
        else if (most < 1e-140) unit = 0x1p600;
    }
#define VOXEL(n) unit*(double)c[n]
#endif
#include "volume/rays/cubic.inl"
#undef VOXEL
#if FLOAT_GRID
    p0 -= isovalue;
#else
    p0 -= unit * isovalue;
#endif
    auto at = [&](double s) { return ((p3 * s + p2) * s + p1) * s + p0; };
    double root = -1.0;
    const int first = p0 > 0.0 ? 1 : p0 < 0.0 ? -1 : 0;
    if (now != 0 || (p0 == 0.0 || first * side < 0)) {
        root = 0.0;
    } else {
        // Roots of the derivative (3 p3, 2 p2, p1), by the formula without cancellation.
        double ends[3] = {1.0, 1.0, 1.0};
        const double square = p2 * p2 - 3.0 * p3 * p1;
        // This test shows most cells to be monotone along the ray.
        if (square > 0.0 && 2.0 * wp::abs(p2) + 3.0 * wp::abs(p3) >= wp::abs(p1)) {
            const double w = -(p2 + (p2 < 0.0 ? -wp::sqrt(square) : wp::sqrt(square)));
            double one = w / (3.0 * p3), two = p1 / w;
            if (!(one > 0.0 && one < 1.0)) one = 1.0;
            if (!(two > 0.0 && two < 1.0)) two = 1.0;
            ends[0] = wp::min(one, two);
            ends[1] = wp::max(one, two);
        }
        double lo = 0.0, at_lo = p0;
        for (int n = 0; n < 3 && root < 0.0 && lo < 1.0; ++n) {
            double hi = ends[n];
            const double at_hi = at(hi);
            if (at_hi == 0.0) {
                root = hi;
            } else if ((at_hi > 0.0) != (at_lo > 0.0) && at_hi == at_hi) {
#if SIDE_BY_SIDE
                if (wp::abs(p0) + wp::abs(p1) + wp::abs(p2) + wp::abs(p3) < LARGEST_SUM) {
                    const int n = found.count++;
                    found.row[n] = q;
#define KEEP(name) found.name[n] = name;
                    BRACKET(KEEP)
#undef KEEP
                    return wp::vec_t<4, double>();
                }
#endif
                // Newton's method, kept between the ends of the bracket.
                double s = lo + (hi - lo) * (at_lo / (at_lo - at_hi)), left_end = lo, right_end = hi;
                double moved = hi - lo;
                for (int round = 0; round < ROUNDS; ++round) {
                    const double v = at(s);
                    if (v == 0.0) break;
                    if ((v > 0.0) == (at_lo > 0.0)) left_end = s;
                    else right_end = s;
                    const double rise = (3.0 * p3 * s + 2.0 * p2) * s + p1;
                    double better = s - v / rise;
                    // Near multiple roots Newton's steps hardly shrink, and bisection is faster.
                    if (!(better >= left_end && better <= right_end && wp::abs(better - s) <= 0.5 * moved))
                        better = 0.5 * (left_end + right_end);
                    moved = wp::abs(better - s);
                    s = better;
                    if (moved <= RESOLUTION) break;
                }
                root = s;
            }
            lo = hi;
            at_lo = at_hi;
        }
        side = at_lo > 0.0 ? 1 : at_lo < 0.0 ? -1 : 0;
    }
    if (root >= 0.0) {
        hit = t0 + (ta + root * (tb - ta));
        const double ux = ex + root * gx, uy = ey + root * gy, uz = ez + root * gz;
        slope[0] = (kx + uy * kxy) + uz * (kxz + uy * kxyz);
        slope[1] = (ky + ux * kxy) + uz * (kyz + ux * kxyz);
        slope[2] = (kz + ux * kxz) + uy * (kyz + ux * kxyz);
        goto done;
    }
} else {
    side = now;
}
