// Exact test of two triangles: whether they intersect, and whether they do so beyond what they share.
//
// Triangles are closed sets: touching counts as intersecting. Triangles without area are segments or points.
#pragma once
#include "mesh/triangle/exact_arithmetic.inl"

// ---- Exact orientation predicates of float64 points: a filter first, expansions where it cannot decide.
//
// Exact unless a product underflows: coordinates of a scale near 1 with differences above 1e-80 are safe.

// Sum is an exact sum: parts that do not overlap, smallest first; the last one has the sign of the sum.
struct Sum {
    double part[PARTS];
    int count;
};
static constexpr auto add = [](Sum& sum, double value) {
    if (value == 0.0) return;
    int kept = 0;
    for (int i = 0; i < sum.count; ++i) {
        const double one = value, other = sum.part[i];
        value = plus(one, other);
        const double back = minus(value, one);
        const double rest = plus(minus(one, minus(value, back)), minus(other, back));
        if (rest != 0.0) sum.part[kept++] = rest;
    }
    if (value != 0.0) sum.part[kept++] = value;
    sum.count = kept;
};
static constexpr auto add_product = [](Sum& sum, double x, double y) {
    const double xy = product(x, y);
    add(sum, fused(x, y, -xy));
    add(sum, xy);
};
static constexpr auto sign_of = [](const Sum& sum) {
    return sum.count == 0 ? 0 : sum.part[sum.count - 1] > 0.0 ? 1 : -1;
};
// x - y as two parts.
static constexpr auto split_difference = [](double x, double y, double* parts) {
    parts[0] = minus(x, y);
    const double back = minus(x, parts[0]);
    parts[1] = plus(minus(x, plus(parts[0], back)), minus(back, y));
};
static constexpr auto exact_orientation = [](const point& a, const point& b, const point& c,
                                             const point& d) OUT_OF_LINE {
    double part[3][3][2];
    for (int k = 0; k < 3; ++k) {
        split_difference(a[k], d[k], part[0][k]);
        split_difference(b[k], d[k], part[1][k]);
        split_difference(c[k], d[k], part[2][k]);
    }
    Sum sum;
    sum.count = 0;
    for (int k = 0; k < 6; ++k) {
        // The six permutations: three even, three odd.
        const int i = k % 3, j = (k < 3 ? k + 1 : k + 2) % 3, l = 3 - i - j;
        for (int bits = 0; bits < 8; ++bits) {
            const double x = part[0][i][bits & 1], y = part[1][j][(bits >> 1) & 1], z = part[2][l][bits >> 2];
            if (x == 0.0 || y == 0.0 || z == 0.0) continue;
            const double xy = product(x, y), rest = fused(x, y, -xy), towards = k < 3 ? z : -z;
            if (rest != 0.0) add_product(sum, rest, towards);
            add_product(sum, xy, towards);
        }
    }
    return sign_of(sum);
};
// Sign of the orientation if rounding leaves no doubt, else 2.
static constexpr auto likely_orientation = [](const point& a, const point& b, const point& c, const point& d) {
    const point ad = a - d, bd = b - d, cd = c - d;
    double det = 0.0, bound = 0.0;
    for (int k = 0; k < 3; ++k) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        const double one = bd[i] * cd[j], other = bd[j] * cd[i];
        det += ad[k] * (one - other);
        bound += wp::abs(ad[k]) * (wp::abs(one) + wp::abs(other));
    }
    bound *= VOLUME_ERROR;
    return det > bound ? 1 : det < -bound ? -1 : 2;
};
// 1 where d lies below the plane through a, b, c seen counterclockwise, -1 above, 0 on it.
static constexpr auto orientation = [](const point& a, const point& b, const point& c, const point& d) OUT_OF_LINE {
    const int likely = likely_orientation(a, b, c, d);
    return likely != 2 ? likely : exact_orientation(a, b, c, d);
};
// The same of a turn.
static constexpr auto likely_turn = [](int k, const point& a, const point& b, const point& c) {
    const int i = (k + 1) % 3, j = (k + 2) % 3;
    const double one = (a[i] - c[i]) * (b[j] - c[j]), other = (a[j] - c[j]) * (b[i] - c[i]);
    const double det = one - other, bound = AREA_ERROR * (wp::abs(one) + wp::abs(other));
    return det > bound ? 1 : det < -bound ? -1 : 2;
};
// 1 where a, b, c are counterclockwise seen along axis k, -1 clockwise, 0 on a line.
static constexpr auto turn = [](int k, const point& a, const point& b, const point& c) OUT_OF_LINE {
    const int likely = likely_turn(k, a, b, c);
    if (likely != 2) return likely;
    double part[4][2];
    const int i = (k + 1) % 3, j = (k + 2) % 3;
    split_difference(a[i], c[i], part[0]);
    split_difference(b[j], c[j], part[1]);
    split_difference(a[j], c[j], part[2]);
    split_difference(b[i], c[i], part[3]);
    Sum sum;
    sum.count = 0;
    for (int x = 0; x < 2; ++x)
        for (int y = 0; y < 2; ++y) {
            add_product(sum, part[0][x], part[1][y]);
            add_product(sum, -part[2][x], part[3][y]);
        }
    return sign_of(sum);
};

// ---- Triangles.

static constexpr auto same = [](const point& a, const point& b) {
    return a[0] == b[0] && a[1] == b[1] && a[2] == b[2];
};
// Whether the boxes of two triangles are no farther apart than a margin.
static constexpr auto boxes_meet = [](const point* t, const point* u, double margin) {
    for (int k = 0; k < 3; ++k)
        if (wp::max(wp::max(t[0][k], t[1][k]), t[2][k]) + margin < wp::min(wp::min(u[0][k], u[1][k]), u[2][k])
            || wp::max(wp::max(u[0][k], u[1][k]), u[2][k]) + margin < wp::min(wp::min(t[0][k], t[1][k]), t[2][k]))
            return false;
    return true;
};

// ---- Exact tests, by predicates only.

// Segments in a plane, seen along axis k.
static constexpr auto flat_segments_meet = [](int k, const point& p, const point& q, const point& a,
                                              const point& b) OUT_OF_LINE {
    const int pa = turn(k, p, q, a), pb = turn(k, p, q, b), ap = turn(k, a, b, p), aq = turn(k, a, b, q);
    if (pa * pb > 0 || ap * aq > 0) return false;
    if (pa != 0 || pb != 0 || ap != 0 || aq != 0) return true;
    for (int axis = 0; axis < 3; ++axis)
        if (axis != k
            && (wp::max(p[axis], q[axis]) < wp::min(a[axis], b[axis])
                || wp::max(a[axis], b[axis]) < wp::min(p[axis], q[axis])))
            return false;
    return true;
};
static constexpr auto segments_meet = [](const point& p, const point& q, const point& a, const point& b) OUT_OF_LINE {
    if (orientation(p, q, a, b) != 0) return false;
    for (int k = 0; k < 3; ++k)
        // Along this axis their plane is not seen edge-on.
        if (turn(k, p, q, a) != 0 || turn(k, p, q, b) != 0 || turn(k, a, b, p) != 0 || turn(k, a, b, q) != 0)
            return flat_segments_meet(k, p, q, a, b);
    for (int k = 0; k < 3; ++k)
        if (wp::max(p[k], q[k]) < wp::min(a[k], b[k]) || wp::max(a[k], b[k]) < wp::min(p[k], q[k])) return false;
    return true;
};
static constexpr auto segment_meets = [](const point& p, const point& q, const point* t) OUT_OF_LINE {
    const int ps = orientation(t[0], t[1], t[2], p), qs = orientation(t[0], t[1], t[2], q);
    if (ps * qs > 0) return false;
    if (ps != 0 || qs != 0) {
        const int u = orientation(p, q, t[0], t[1]), v = orientation(p, q, t[1], t[2]),
                  w = orientation(p, q, t[2], t[0]);
        return (u >= 0 && v >= 0 && w >= 0) || (u <= 0 && v <= 0 && w <= 0);
    }
    for (int k = 0; k < 3; ++k) {
        const int side = turn(k, t[0], t[1], t[2]);
        if (side == 0) continue;
        for (int end = 0; end < 2; ++end) {
            const point& x = end ? q : p;
            if (turn(k, t[0], t[1], x) * side >= 0 && turn(k, t[1], t[2], x) * side >= 0
                && turn(k, t[2], t[0], x) * side >= 0)
                return true;
        }
        return flat_segments_meet(k, p, q, t[0], t[1]) || flat_segments_meet(k, p, q, t[1], t[2])
               || flat_segments_meet(k, p, q, t[2], t[0]);
    }
    return segments_meet(p, q, t[0], t[1]) || segments_meet(p, q, t[1], t[2]) || segments_meet(p, q, t[2], t[0]);
};
// Whether p is between a and b or is one of them; all three are on one line.
static constexpr auto between = [](const point& a, const point& p, const point& b) {
    for (int k = 0; k < 3; ++k)
        if (p[k] < wp::min(a[k], b[k]) || p[k] > wp::max(a[k], b[k])) return false;
    return true;
};
static constexpr auto on_a_line = [](const point* t) OUT_OF_LINE {
    return turn(0, t[0], t[1], t[2]) == 0 && turn(1, t[0], t[1], t[2]) == 0 && turn(2, t[0], t[1], t[2]) == 0;
};
// Triangles that share t[0] = u[0]: a ray from there through another common point leaves one of them first, through the
// opposite side, or through an end of it if they are segments that continue beyond the shared point.
static constexpr auto meet_beyond_vertex = [](const point* t, const point* u) OUT_OF_LINE {
    const bool t_through = on_a_line(t) && between(t[1], t[0], t[2]);
    const bool u_through = on_a_line(u) && between(u[1], u[0], u[2]);
    if (t_through ? segment_meets(t[1], t[1], u) || segment_meets(t[2], t[2], u) : segment_meets(t[1], t[2], u))
        return true;
    return u_through ? segment_meets(u[1], u[1], t) || segment_meets(u[2], u[2], t) : segment_meets(u[1], u[2], t);
};
// Triangles that share t[0] = u[0] and t[1] = u[1]: they intersect only if folded over each other, or as segments
// beyond one end.
static constexpr auto meet_beyond_edge = [](const point* t, const point* u) OUT_OF_LINE {
    if (orientation(t[0], t[1], t[2], u[2]) != 0) return false;
    for (int k = 0; k < 3; ++k) {
        const int sides = turn(k, t[0], t[1], t[2]) * turn(k, t[0], t[1], u[2]);
        if (sides != 0) return sides > 0;
    }
    if (!on_a_line(t) || !on_a_line(u)) return false;
    const bool beyond_first = between(t[1], t[0], t[2]) && between(t[1], t[0], u[2]);
    const bool beyond_second = between(t[0], t[1], t[2]) && between(t[0], t[1], u[2]);
    return beyond_first || beyond_second;
};

// ---- Fast proofs that they do not intersect: a separating plane, with slack for rounding.

static constexpr auto apart = [](const point& axis, const point* t, const point* u, double size) {
    double above = -INFINITY, below = INFINITY, other_above = -INFINITY, other_below = INFINITY;
    for (int k = 0; k < 3; ++k) {
        const double x = wp::dot(axis, t[k]), y = wp::dot(axis, u[k]);
        above = wp::max(above, x);
        below = wp::min(below, x);
        other_above = wp::max(other_above, y);
        other_below = wp::min(other_below, y);
    }
    const double gap = PAIR_GAP_ERROR * (wp::abs(axis[0]) + wp::abs(axis[1]) + wp::abs(axis[2])) * size;
    return other_below - above > gap || below - other_above > gap;
};
static constexpr auto largest = [](const point& a) {
    return wp::max(wp::max(wp::abs(a[0]), wp::abs(a[1])), wp::abs(a[2]));
};
static constexpr auto surely_apart = [](const point* t, const point* u) {
    // Relative to a corner: the differences are exact to their last bit.
    point a[3], b[3];
    double size = 0.0;
    for (int k = 0; k < 3; ++k) {
        a[k] = t[k] - t[0];
        b[k] = u[k] - t[0];
        size = wp::max(size, wp::max(largest(a[k]), largest(b[k])));
    }
    const point n = wp::cross(a[1], a[2]);
    if (apart(n, a, b, size)) return true;
    const point m = wp::cross(b[1] - b[0], b[2] - b[0]);
    if (apart(m, a, b, size)) return true;
    for (int k = 0; k < 3; ++k) {
        if (apart(wp::cross(n, a[(k + 1) % 3] - a[k]), a, b, size)) return true;
        if (apart(wp::cross(m, b[(k + 1) % 3] - b[k]), a, b, size)) return true;
    }
    return false;
};
// For t[0] = u[0]: a plane through it that has the rest of t on one side and the rest of u on the other.
static constexpr auto surely_split_at_vertex = [](const point* t, const point* u) OUT_OF_LINE {
    const point a = t[1] - t[0], b = t[2] - t[0], c = u[1] - t[0], d = u[2] - t[0];
    auto weight = [](const point& v) { return 1.f / (wp::sqrt((float)wp::dot(v, v)) + 1e-30f); };
    const point n = a * (double)weight(a) + b * (double)weight(b) - c * (double)weight(c) - d * (double)weight(d);
    const double size = wp::max(wp::max(largest(a), largest(b)), wp::max(largest(c), largest(d)));
    const double gap = PAIR_GAP_ERROR * (wp::abs(n[0]) + wp::abs(n[1]) + wp::abs(n[2])) * size;
    if (wp::dot(n, a) > gap && wp::dot(n, b) > gap && wp::dot(n, c) < -gap && wp::dot(n, d) < -gap) return true;
    const int us = likely_orientation(t[0], t[1], t[2], u[1]);
    if (us != 2 && us == likely_orientation(t[0], t[1], t[2], u[2])) return true;
    const int ts = likely_orientation(u[0], u[1], u[2], t[1]);
    return ts != 2 && ts == likely_orientation(u[0], u[1], u[2], t[2]);
};
// For t[0] = u[0] and t[1] = u[1]: seen along the axis that t faces most, they lie on opposite sides of the shared
// edge.
static constexpr auto surely_split_at_edge = [](const point* t, const point* u) OUT_OF_LINE {
    const point n = wp::cross(t[1] - t[0], t[2] - t[0]);
    const double x = wp::abs(n[0]), y = wp::abs(n[1]), z = wp::abs(n[2]);
    const int k = x >= y ? (x >= z ? 0 : 2) : (y >= z ? 1 : 2);
    if (likely_turn(k, t[0], t[1], t[2]) * likely_turn(k, t[0], t[1], u[2]) == -1) return true;
    return likely_orientation(t[0], t[1], t[2], u[2]) != 2;
};

static constexpr auto triangles_meet = [](const point* t, const point* u) OUT_OF_LINE {
    if (surely_apart(t, u)) return false;
    for (int k = 0; k < 3; ++k) {
        if (segment_meets(t[k], t[(k + 1) % 3], u) || segment_meets(u[k], u[(k + 1) % 3], t)) return true;
    }
    return false;
};
// Whether they have a common point that is not on the vertex or edge that they share by position; triangles with the
// same three positions do.
static constexpr auto meet_beyond_shared = [](const point* t, const point* u) {
    int t_shares = 0, u_shares = 0;  // bits of the corners that the other one has too
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            if (same(t[i], u[j])) {
                t_shares |= 1 << i;
                u_shares |= 1 << j;
            }
    if (t_shares == 0) return triangles_meet(t, u);
    if (t_shares == 7 || u_shares == 7) return t_shares == u_shares;
    // The shared corners first; a corner that occurs twice in a triangle without area counts once.
    point a[3], b[3];
    int shared = 0, of_t = 0, of_u = 2;
    for (int i = 0; i < 3; ++i) {
        if (!(t_shares & 1 << i)) continue;
        bool twice = false;
        for (int k = 0; k < shared; ++k) twice = twice || same(a[k], t[i]);
        if (!twice) {
            a[shared] = t[i];
            b[shared++] = t[i];
        }
    }
    of_t = of_u = shared;
    for (int i = 0; i < 3; ++i) {
        if (!(t_shares & 1 << i) && of_t < 3) a[of_t++] = t[i];
        if (!(u_shares & 1 << i) && of_u < 3) b[of_u++] = u[i];
    }
    while (of_t < 3) {
        a[of_t] = a[of_t - 1];
        ++of_t;
    }
    while (of_u < 3) {
        b[of_u] = b[of_u - 1];
        ++of_u;
    }
    if (shared == 1) return !surely_split_at_vertex(a, b) && meet_beyond_vertex(a, b);
    return !surely_split_at_edge(a, b) && meet_beyond_edge(a, b);
};
