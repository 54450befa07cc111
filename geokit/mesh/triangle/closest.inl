// Closest point of a triangle to a query, in float64.
#pragma once

typedef wp::vec_t<3, wp::float64> point;
static constexpr auto squared_at = [](const point& ap, const point& ab, const point& ac, double v, double w) {
    const double x = ap[0] - v * ab[0] - w * ac[0];
    const double y = ap[1] - v * ab[1] - w * ac[1];
    const double z = ap[2] - v * ab[2] - w * ac[2];
    return x * x + y * y + z * z;
};
static constexpr auto closest_on_sliver = [](const point& ap, const point& ab, const point& ac, double& v, double& w) {
    auto share = [](double part, double whole) {
        return part <= 0.0 || whole <= 0.0 ? 0.0 : part >= whole ? 1.0 : part / whole;
    };
    const point bc = ac - ab, bp = ap - ab;
    const double on_ab = share(wp::dot(ap, ab), wp::dot(ab, ab));
    const double on_ac = share(wp::dot(ap, ac), wp::dot(ac, ac));
    const double on_bc = share(wp::dot(bp, bc), wp::dot(bc, bc));
    v = on_ab;
    w = 0.0;
    double least = squared_at(ap, ab, ac, v, w);
    double squared = squared_at(ap, ab, ac, 0.0, on_ac);
    if (squared < least) {
        least = squared;
        v = 0.0;
        w = on_ac;
    }
    squared = squared_at(ap, ab, ac, 1.0 - on_bc, on_bc);
    if (squared < least) {
        least = squared;
        v = 1.0 - on_bc;
        w = on_bc;
    }
    // The interior, by cross products and one refinement step for the residual: the first solution of a thin system
    // has few correct digits, and its correction gives the rest.
    const point n = wp::cross(ab, ac);
    const double nn = wp::dot(n, n);
    if (nn > 0.0) {
        double s = wp::dot(wp::cross(ap, ac), n) / nn, t = wp::dot(wp::cross(ab, ap), n) / nn;
        for (int k = 0; k < 3; ++k) {
            const point rest = ap - s * ab - t * ac;
            s += wp::dot(wp::cross(rest, ac), n) / nn;
            t += wp::dot(wp::cross(ab, rest), n) / nn;
        }
        if (s >= 0.0 && t >= 0.0 && s + t <= 1.0) {
            squared = squared_at(ap, ab, ac, s, t);
            if (squared < least) {
                least = squared;
                v = s;
                w = t;
            }
        }
    }
    return least;
};
// The squared distance of p from the triangle abc, given p - a, b - a and c - a, and the weights v of b and w of c
// there.
//
// The tree search and the evaluation of its winner share it, and so agree to the last bit.
static constexpr auto closest_on_triangle = [](const point& ap, const point& ab, const point& ac, double& v,
                                               double& w) {
    const double bb = wp::dot(ab, ab), cc = wp::dot(ac, ac), bc = wp::dot(ab, ac);
    const double longer = bb > cc ? bb : cc;
    if (bb * cc - bc * bc <= SLIVER_SINE_SQUARED * longer * longer) return closest_on_sliver(ap, ab, ac, v, w);
    const double d1 = wp::dot(ab, ap), d2 = wp::dot(ac, ap);
    const double d3 = d1 - bb, d4 = d2 - bc, d5 = d1 - bc, d6 = d2 - cc;
    const double vc = d1 * d4 - d3 * d2, vb = d5 * d2 - d1 * d6, va = d3 * d6 - d5 * d4;
    if (d1 <= 0.0 && d2 <= 0.0) {
        v = 0.0;
        w = 0.0;
    } else if (d3 >= 0.0 && d4 <= d3) {
        v = 1.0;
        w = 0.0;
    } else if (d6 >= 0.0 && d5 <= d6) {
        v = 0.0;
        w = 1.0;
    } else if (vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0) {
        v = d1 / bb;
        w = 0.0;
    } else if (vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0) {
        v = 0.0;
        w = d2 / cc;
    } else if (va <= 0.0 && d4 >= d3 && d5 >= d6) {
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        v = 1.0 - w;
    } else {
        const double whole = va + vb + vc;
        v = vb / whole;
        w = vc / whole;
    }
    return squared_at(ap, ab, ac, v, w);
};

// Barycentric coordinates of the point of the triangle abc that is closest to p.
static constexpr auto barycentric_of_closest = [](const point& p, const point& a, const point& b,
                                                  const point& c) -> point {
    double v, w;
    closest_on_triangle(p - a, b - a, c - a, v, w);
    // Exactly zero on the edge opposite the first corner: a caller that looks up a normal must recognize the edge.
    const double rest = 1.0 - w;
    return point(v == rest ? 0.0 : rest - v, v, w);
};
