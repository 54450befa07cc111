// Distance and weights of a hit on a sliver, to full precision.
//
// The weights of a sliver, and t with them, lose as many digits along its longest edge as that edge exceeds its height.
// Its plane does not lose them: from the corner between the two shorter edges, with a normal whose components are exact
// to a few roundings (Kahan's difference of products), the error of t is some roundings of the longest edge. t is kept
// within the triangle; if the triangle is seen edge-on, t comes from its longest edge. The weights are then those of
// the point that lies as far along that edge as t says.
//
// Expects exact_arithmetic.inl and ray_triangle.inl (pick); tree. Defines difference_of_products and
// refine_sliver(start, direction, slot, t, v, w).
auto difference_of_products = [&](double p, double q, double r, double s) {
    const double rs = product(r, s);
    return plus(fused(p, q, -rs), fused(-r, s, rs));
};
auto refine_sliver = [&](const point& start, const point& direction, int slot, double& t, double& v, double& w) {
    const point a = tree.corners.data[3 * slot], b = tree.corners.data[3 * slot + 1],
                c = tree.corners.data[3 * slot + 2];
    const point ab = b - a, bc = c - b, ca = a - c;
    const double ab2 = wp::dot(ab, ab), bc2 = wp::dot(bc, bc), ca2 = wp::dot(ca, ca);
    // The longest edge runs from corner i to corner j.
    const int o = bc2 >= ca2 ? (bc2 >= ab2 ? 0 : 2) : (ca2 >= ab2 ? 1 : 2), i = (o + 1) % 3;
    const point edge = o == 0 ? bc : o == 1 ? ca : ab;
    const point e = o == 0 ? ab : o == 1 ? bc : ca, f = o == 0 ? -ca : o == 1 ? -ab : -bc;
    const point normal(difference_of_products(e[1], f[2], e[2], f[1]), difference_of_products(e[2], f[0], e[0], f[2]),
                       difference_of_products(e[0], f[1], e[1], f[0]));
    const double length2 = wp::dot(edge, edge);
    if (length2 == 0.0) return;
    // From the start of the ray to the ends of the edge and to the opposite corner.
    const point first = (i == 0 ? a : i == 1 ? b : c) - start, opposite = (o == 0 ? a : o == 1 ? b : c) - start;
    const point last = first + edge;
    const int axis = wp::abs(direction[0]) >= wp::abs(direction[1])
                         ? (wp::abs(direction[0]) >= wp::abs(direction[2]) ? 0 : 2)
                         : (wp::abs(direction[1]) >= wp::abs(direction[2]) ? 1 : 2);
    const double step = pick(direction, axis), of_first = pick(first, axis) / step, of_last = pick(last, axis) / step,
                 of_opposite = pick(opposite, axis) / step;
    const double slope = wp::dot(normal, direction);
    if (slope != 0.0) {
        t = wp::dot(normal, opposite) / slope;
    } else {
        // Seen along the ray: the point of the edge that is closest to it.
        const double along2 = wp::dot(direction, direction);
        const point seen = edge - direction * (wp::dot(edge, direction) / along2);
        const double seen2 = wp::dot(seen, seen), share = seen2 > 0.0 ? -wp::dot(first, seen) / seen2 : 0.5;
        t = of_first + wp::min(wp::max(share, 0.0), 1.0) * (of_last - of_first);
    }
    t = wp::max(t, wp::min(wp::min(of_first, of_last), of_opposite));
    t = wp::min(t, wp::max(wp::max(of_first, of_last), of_opposite));
    const double weight_o = o == 0 ? 1.0 - v - w : o == 1 ? v : w;
    const double along = (wp::dot(direction * t - first, edge) + weight_o * wp::dot(e, edge)) / length2;
    const double weight_j = wp::min(wp::max(along, 0.0), 1.0 - weight_o);
    const double weight_i = 1.0 - weight_o - weight_j;
    v = o == 1 ? weight_o : i == 1 ? weight_i : weight_j;
    w = o == 2 ? weight_o : i == 2 ? weight_i : weight_j;
};
