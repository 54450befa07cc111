// Exact orientation predicates of float64 points: a floating-point filter first, expansions where it cannot decide.
//
// Exact unless a product underflows: coordinates of a scale near 1 with differences above 1e-80 are safe.
#pragma once
#include "mesh/bvh/exact_arithmetic.inl"

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
