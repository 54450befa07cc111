// The search for the first crossing of an isovalue along a ray, cell by cell.
#pragma once
#include "volume/rays/ray.inl"

struct Crossing {
    // The side of the isovalue on which the ray was last, 0 if unknown. Two cells may round differently on the face
    // between them. A change of side there counts as a crossing, so that none is lost between cells.
    int side;
    // The crossing's t, infinite for none, and the gradient there in index space.
    double hit, slope[3];
};
// Where a change of sign brackets one root of a cubic.
struct Bracket {
    double lo, hi, at_lo, at_hi;
};

// The side of the isovalue on which a voxel is; 2 for NaN. Voxels are compared with it, or its neighbors, in their own
// type.
static constexpr auto side_of = [](auto v, auto below, auto above) -> int {
    return v > (decltype(v))below ? 1 : v < (decltype(v))above ? -1 : v == v ? 0 : 2;
};

// The state at the ray's entry into the box; whether the search ends there.
static constexpr auto begin_search = [](const Ray& ray, auto background, auto below, auto above,
                                        Crossing& found) -> bool {
    found = {0, (double)INFINITY, {0.0, 0.0, 0.0}};
    if (!(ray.t_first <= ray.t_last)) return true;
    if (ray.entered) {
        found.side = side_of(background, below, above);
        if (found.side == 0) {
            found.hit = ray.t_first;
            return true;
        }
        if (found.side == 2) found.side = 0;
    }
    return false;
};

// The end of a search at the end of the box or of the ray.
static constexpr auto end_search = [](const Ray& ray, auto background, auto below, auto above, Crossing& found) {
    if (!ray.left) return;
    const int now = side_of(background, below, above);
    if (now == 0 || (now != 2 && now * found.side < 0)) found.hit = ray.t0 + ray.last;
};

// Finds the first crossing of the isovalue in a cell, whose voxels are c; whether there is one. Between the roots of its
// derivative the cubic is monotone, so a change of sign there brackets exactly one root. put_off(cubic, bracket): whether
// that root is found by others.
static constexpr auto crosses_cell = [](const Ray& ray, const auto* c, bool mixed, double isovalue, auto below,
                                        auto above, Crossing& found, auto&& put_off) -> bool {
    typedef decltype(c[0] + c[0]) real;
    if (ray.unseen >= 0) found.side = c[ray.unseen] > (real)below ? 1 : -1;
    bool over = !mixed, under = !mixed;
    for (int m = 0; m < 8; ++m) {
        over = over & (c[m] > (real)below);
        under = under & (c[m] < (real)above);
    }
    const int now = over ? 1 : under ? -1 : 0;
    if (now != 0 && now * found.side >= 0) {
        found.side = now;
        return false;
    }
    // If squares overflow or underflow in double, the cubic's turning points are lost. Such cells are scaled by a power
    // of two, which rounds nothing. Squares of float32 numbers are far from these limits.
    constexpr bool scales = sizeof(real) > sizeof(float);
    double unit = 1.0;
    if (scales) {
        double most = wp::abs(isovalue);
        for (int m = 0; m < 8; ++m) most = wp::max(most, wp::abs((double)c[m]));
        if (most > 1e140) unit = 0x1p-600;
        else if (most < 1e-140) unit = 0x1p600;
    }
    Cubic cubic = cubic_of(ray, [&](int n) { return scales ? unit * (double)c[n] : (double)c[n]; });
    cubic.p0 -= scales ? unit * isovalue : isovalue;
    const double p0 = cubic.p0, p1 = cubic.p1, p2 = cubic.p2, p3 = cubic.p3;
    auto at = [&](double s) { return ((p3 * s + p2) * s + p1) * s + p0; };
    double root = -1.0;
    const int first = p0 > 0.0 ? 1 : p0 < 0.0 ? -1 : 0;
    if (now != 0 || (p0 == 0.0 || first * found.side < 0)) {
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
                if (put_off(cubic, Bracket{lo, hi, at_lo, at_hi})) return true;
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
        found.side = at_lo > 0.0 ? 1 : at_lo < 0.0 ? -1 : 0;
    }
    if (!(root >= 0.0)) return false;
    found.hit = ray.t0 + (ray.ta + root * (ray.tb - ray.ta));
    const double ux = cubic.ex + root * cubic.gx, uy = cubic.ey + root * cubic.gy, uz = cubic.ez + root * cubic.gz;
    found.slope[0] = (cubic.kx + uy * cubic.kxy) + uz * (cubic.kxz + uy * cubic.kxyz);
    found.slope[1] = (cubic.ky + ux * cubic.kxy) + uz * (cubic.kyz + ux * cubic.kxyz);
    found.slope[2] = (cubic.kz + ux * cubic.kxz) + uy * (cubic.kyz + ux * cubic.kxyz);
    return true;
};
