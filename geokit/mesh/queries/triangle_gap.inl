// Distance of two triangles, and the points of theirs that are nearest to each other.
//
// Triangles that do not meet are nearest at a vertex of one and a point of the other, or inside an edge of each.
// Expects exact_arithmetic.inl, predicates.inl, triangle_pair.inl and closest_on_triangle.inl. Defines
// triangle_gap(t, u, x, y) for arrays of three points: returns the squared distance and sets x on t and y on u; 0 and a
// common point, to rounding, where they meet, which is decided exactly. Also defines vertex_gap, edge_gap, feature_gap
// and boxes_meet.
auto vertex_gap = [&](const point& p, const point* u, point& y) {
    const point ab = u[1] - u[0], ac = u[2] - u[0];
    double v, w;
    const double squared = closest_on_triangle(p - u[0], ab, ac, v, w);
    y = u[0] + v * ab + w * ac;
    return squared;
};
// The segments p + s d and q + r e. Their inner minimum from cross products: of nearly parallel segments the first
// solution has few correct digits, and its correction gives the rest. Ends are vertices, and those are tested anyway.
auto edge_gap = [&](const point& p, const point& d, const point& q, const point& e, double& s, double& r) {
    auto share = [](double part, double whole) { return part <= 0.0 ? 0.0 : part >= whole ? 1.0 : part / whole; };
    const point n = wp::cross(d, e);
    const double nn = wp::dot(n, n);
    if (!(nn > 0.0)) return (double)INFINITY;
    const point apart = p - q;
    s = r = 0.0;
    for (int k = 0; k < 2; ++k) {
        const point rest = apart + s * d - r * e;
        s -= wp::dot(wp::cross(rest, e), n) / nn;
        r -= wp::dot(wp::cross(rest, d), n) / nn;
    }
    s = s > 0.0 ? wp::min(s, 1.0) : 0.0;
    r = share(wp::dot(apart + s * d, e), wp::dot(e, e));
    s = share(wp::dot(r * e - apart, d), wp::dot(d, d));
    const point rest = apart + s * d - r * e;
    return wp::dot(rest, rest);
};
auto feature_gap = [&](const point* t, const point* u, point& x, point& y) OUT_OF_LINE {
    double least = INFINITY;
    for (int side = 0; side < 2; ++side)
        for (int k = 0; k < 3; ++k) {
            const point p = side ? u[k] : t[k];
            point q;
            const double squared = vertex_gap(p, side ? t : u, q);
            if (squared >= least) continue;
            least = squared;
            x = side ? q : p;
            y = side ? p : q;
        }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            const point d = t[(i + 1) % 3] - t[i], e = u[(j + 1) % 3] - u[j];
            double s, r;
            const double squared = edge_gap(t[i], d, u[j], e, s, r);
            if (squared >= least) continue;
            least = squared;
            x = t[i] + s * d;
            y = u[j] + r * e;
        }
    return least;
};
auto boxes_meet = [&](const point* t, const point* u) {
    for (int k = 0; k < 3; ++k)
        if (wp::max(wp::max(t[0][k], t[1][k]), t[2][k]) < wp::min(wp::min(u[0][k], u[1][k]), u[2][k])
            || wp::max(wp::max(u[0][k], u[1][k]), u[2][k]) < wp::min(wp::min(t[0][k], t[1][k]), t[2][k]))
            return false;
    return true;
};
auto triangle_gap = [&](const point* t, const point* u, point& x, point& y) OUT_OF_LINE {
    const bool meet = boxes_meet(t, u) && triangles_meet(t, u);
    double least = feature_gap(t, u, x, y);
    // Rounding may make 0 of a gap: triangles that do not meet are apart.
    if (!meet) return wp::max(least, 1e-300);
    // Where an edge goes through the other triangle, no vertex and no other edge need be near.
    for (int side = 0; side < 2; ++side) {
        const point *one = side ? u : t, *other = side ? t : u;
        const point n = wp::cross(other[1] - other[0], other[2] - other[0]);
        for (int k = 0; k < 3; ++k) {
            const point p = one[k], q = one[(k + 1) % 3];
            const double from = wp::dot(n, p - other[0]), to = wp::dot(n, q - other[0]);
            if (!(from * to < 0.0)) continue;
            const point through = p + (from / (from - to)) * (q - p);
            point found;
            const double squared = vertex_gap(through, other, found);
            if (squared >= least) continue;
            least = squared;
            x = through;
        }
    }
    y = x;
    return 0.0;
};
