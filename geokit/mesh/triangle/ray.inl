// Exact test of a ray against a triangle, in float64 (Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection", JCGT
// 2013). Differs: all in float64, no fallback needed.
//
// The edge functions of the two triangles at an edge must be exact negatives of each other: a fused multiply-add would
// round the two products of each differently, and a ray through the edge could miss both.
//
// Without CROSSINGS a ray through an edge or a vertex hits all triangles there, so that closed surfaces have no holes.
// With CROSSINGS it hits as many triangles there as a ray displaced by an infinitesimal (e, e^2) in x and y of the
// sheared frame: each passage through the surface counts once, a touch from one side twice or not at all (Edelsbrunner,
// Muecke, "Simulation of Simplicity", 1990). Signs are those of the exact determinants of the sheared corners, so that
// they belong to one arrangement of points in the plane, and any line crosses a closed surface an even number of times.
#pragma once
#include "mesh/triangle/exact_arithmetic.inl"

#if defined(__CUDA_ARCH__)
// A GPU can index only memory: an index that is not known at compile time would keep all points there.
static constexpr auto pick = [](const point& p, int k) { return k == 0 ? p[0] : k == 1 ? p[1] : p[2]; };
#else
static constexpr auto pick = [](const point& p, int k) { return p[k]; };
#endif
// A ray, and its length in units of its direction. False, and out_bad[0] is set, for one that has no direction or is not
// finite: the host rejects the whole batch then and names the row; where a graph makes the launch it is a miss.
static constexpr auto fetch_ray = [](const wp::array_t<wp::vec3d>& origins, const wp::array_t<wp::vec3d>& directions,
                                     int ray, double max_distance, point& start, point& direction, double& t_max,
                                     wp::array_t<int>& out_bad) {
    start = origins.data[ray];
    direction = directions.data[ray];
    t_max = max_distance < (double)INFINITY ? max_distance / wp::length(direction) : max_distance;
    const double largest = wp::max(wp::max(wp::abs(direction[0]), wp::abs(direction[1])), wp::abs(direction[2]));
    // x - x is zero, unless x is infinite or NaN.
    const point none = (start - start) + (direction - direction);
    const bool is_usable = largest >= SHORTEST_DIRECTION && none[0] + none[1] + none[2] == 0.0;
    if (!is_usable) out_bad.data[0] = 1;
    return is_usable;
};
// False if the line misses the triangle in a slot; t in units of the direction, v and w the weights of b and c.
static constexpr auto hit_at_all = [](const SurfaceTree& tree, const point& start, const point& direction, int slot,
                                      double& t, double& v, double& w) {
    double size[3] = {direction[0] < 0 ? -direction[0] : direction[0], direction[1] < 0 ? -direction[1] : direction[1],
                      direction[2] < 0 ? -direction[2] : direction[2]};
    // The axis of the ray's largest component becomes z of a sheared frame in which the ray is the z axis.
    const int kz = size[0] >= size[1] ? (size[0] >= size[2] ? 0 : 2) : (size[1] >= size[2] ? 1 : 2);
    const double most = pick(direction, kz);
    const int kx = most < 0.0 ? (kz + 2) % 3 : (kz + 1) % 3;
    const int ky = most < 0.0 ? (kz + 1) % 3 : (kz + 2) % 3;
    const double sz = 1.0 / most, sx = pick(direction, kx) * sz, sy = pick(direction, ky) * sz;
    // Relative to the start of the ray, along the axes of that frame.
    auto from_start = [&](int corner) {
        const point& p = tree.corners.data[3 * slot + corner];
        return point(pick(p, kx) - pick(start, kx), pick(p, ky) - pick(start, ky), pick(p, kz) - pick(start, kz));
    };
    const point a = from_start(0), b = from_start(1), c = from_start(2);
    const double ax = minus(a[0], product(sx, a[2])), ay = minus(a[1], product(sy, a[2]));
    const double bx = minus(b[0], product(sx, b[2])), by = minus(b[1], product(sy, b[2]));
    const double cx = minus(c[0], product(sx, c[2])), cy = minus(c[1], product(sy, c[2]));
    double fa = minus(product(cx, by), product(cy, bx));
    double fb = minus(product(ax, cy), product(ay, cx));
    double fc = minus(product(bx, ay), product(by, ax));
    if (CROSSINGS) {
        auto side = [&](double px, double py, double qx, double qy, double f) {
            // Sign of px * qy - py * qx, whose rounded value is f.
            const double one = product(px, qy), other = product(py, qx);
            const double bound = 4e-16 * ((one < 0.0 ? -one : one) + (other < 0.0 ? -other : other));
            if (f > bound) return 1;
            if (f < -bound) return -1;
            const double rest = (one - other) + (fused(px, qy, -one) - fused(py, qx, -other));
            if (rest != 0.0) return rest > 0.0 ? 1 : -1;
            if (py != qy) return py > qy ? 1 : -1;
            return px == qx ? 0 : qx > px ? 1 : -1;
        };
        const int ea = side(cx, cy, bx, by, fa), eb = side(ax, ay, cx, cy, fb), ec = side(bx, by, ax, ay, fc);
        if (ea == 0 || ea != eb || eb != ec) return false;
        // Rounding may have moved a function to the wrong side of zero.
        if (fa * ea < 0.0) fa = 0.0;
        if (fb * ea < 0.0) fb = 0.0;
        if (fc * ea < 0.0) fc = 0.0;
    } else if ((fa < 0.0 || fb < 0.0 || fc < 0.0) && (fa > 0.0 || fb > 0.0 || fc > 0.0)) return false;
    double whole = fa + fb + fc;
    if (whole == 0.0) {
        if (!CROSSINGS) return false;  // seen edge-on: its neighbors take the ray
        fa = fb = fc = 1.0;
        whole = 3.0;  // hit, at a place that rounding hides
    }
    v = fb / whole;
    w = fc / whole;
    t = plus(plus(product(fa, a[2]), product(fb, b[2])), product(fc, c[2])) * sz / whole;
    return true;
};

static constexpr auto difference_of_products = [](double p, double q, double r, double s) {
    const double rs = product(r, s);
    return plus(fused(p, q, -rs), fused(-r, s, rs));
};
static constexpr auto dot_of = [](const point& p, const point& q) {
    return plus(plus(product(p[0], q[0]), product(p[1], q[1])), product(p[2], q[2]));
};
// p - scale * q.
static constexpr auto minus_scaled = [](const point& p, const point& q, double scale) {
    return point(minus(p[0], product(q[0], scale)), minus(p[1], product(q[1], scale)),
                 minus(p[2], product(q[2], scale)));
};
// Distance and weights of a hit on a sliver, to full precision.
//
// The weights of a sliver, and t with them, lose as many digits along its longest edge as that edge exceeds its height.
// Its plane does not lose them: from the corner between the two shorter edges, with a normal whose components are exact
// to a few roundings (Kahan's difference of products), the error of t is some roundings of the longest edge. t is kept
// within the triangle; if the triangle is seen edge-on, t comes from its longest edge. The weights are then those of
// the point that lies as far along that edge as t says.
static constexpr auto refine_sliver = [](const SurfaceTree& tree, const point& start, const point& direction, int slot,
                                         double& t, double& v, double& w) {
    const point a = tree.corners.data[3 * slot], b = tree.corners.data[3 * slot + 1],
                c = tree.corners.data[3 * slot + 2];
    const point ab = b - a, bc = c - b, ca = a - c;
    const double ab2 = dot_of(ab, ab), bc2 = dot_of(bc, bc), ca2 = dot_of(ca, ca);
    // The longest edge runs from corner i to corner j.
    const int o = bc2 >= ca2 ? (bc2 >= ab2 ? 0 : 2) : (ca2 >= ab2 ? 1 : 2), i = (o + 1) % 3;
    const point edge = o == 0 ? bc : o == 1 ? ca : ab;
    const point e = o == 0 ? ab : o == 1 ? bc : ca, f = o == 0 ? -ca : o == 1 ? -ab : -bc;
    const point normal(difference_of_products(e[1], f[2], e[2], f[1]), difference_of_products(e[2], f[0], e[0], f[2]),
                       difference_of_products(e[0], f[1], e[1], f[0]));
    const double length2 = dot_of(edge, edge);
    if (length2 == 0.0) return;
    // From the start of the ray to the ends of the edge and to the opposite corner.
    const point first = (i == 0 ? a : i == 1 ? b : c) - start, opposite = (o == 0 ? a : o == 1 ? b : c) - start;
    const point last = first + edge;
    const int axis = wp::abs(direction[0]) >= wp::abs(direction[1])
                         ? (wp::abs(direction[0]) >= wp::abs(direction[2]) ? 0 : 2)
                         : (wp::abs(direction[1]) >= wp::abs(direction[2]) ? 1 : 2);
    const double step = pick(direction, axis), of_first = pick(first, axis) / step, of_last = pick(last, axis) / step,
                 of_opposite = pick(opposite, axis) / step;
    const double slope = dot_of(normal, direction);
    if (slope != 0.0) {
        t = dot_of(normal, opposite) / slope;
    } else {
        // Seen along the ray: the point of the edge that is closest to it.
        const double along2 = dot_of(direction, direction);
        const point seen = minus_scaled(edge, direction, dot_of(edge, direction) / along2);
        const double seen2 = dot_of(seen, seen), share = seen2 > 0.0 ? -dot_of(first, seen) / seen2 : 0.5;
        t = plus(of_first, product(wp::min(wp::max(share, 0.0), 1.0), of_last - of_first));
    }
    t = wp::max(t, wp::min(wp::min(of_first, of_last), of_opposite));
    t = wp::min(t, wp::max(wp::max(of_first, of_last), of_opposite));
    const double weight_o = o == 0 ? 1.0 - v - w : o == 1 ? v : w;
    const double along =
        plus(-dot_of(minus_scaled(first, direction, t), edge), product(weight_o, dot_of(e, edge))) / length2;
    const double weight_j = wp::min(wp::max(along, 0.0), 1.0 - weight_o);
    const double weight_i = 1.0 - weight_o - weight_j;
    v = o == 1 ? weight_o : i == 1 ? weight_i : weight_j;
    w = o == 2 ? weight_o : i == 2 ? weight_i : weight_j;
};

// The leaf's own numbers tell which triangles are slivers, by the ratio of height to longest edge. On a CPU they are
// already a bit of the leaf that the traversal has just read.
static constexpr auto is_sliver = [](const SurfaceTree& tree, int slot) {
    #if defined(__CUDA_ARCH__)
    const float* const number = tree.leaves.data + SLOT_WORDS * slot;
    return number[14] < SLIVER * number[12];
    #else
    const float* const head = tree.ray_leaves.data + LEAF_WORDS * (wp::int64)(slot >> 3) + HEAD;
    return (((const unsigned*)head)[6] >> 8 >> (slot & 7) & 1u) != 0;
    #endif
};
static constexpr auto refine = [](const SurfaceTree& tree, const point& start, const point& direction, int slot,
                                  double& t, double& v, double& w) {
    if (is_sliver(tree, slot)) refine_sliver(tree, start, direction, slot, t, v, w);
};

// False if the ray misses the triangle in a slot, or hits it before t_min. Without CROSSINGS t is refined before it is
// compared with anything; with them a sliver's t may have lost digits.
static constexpr auto hit = [](const SurfaceTree& tree, double t_min, const point& start, const point& direction,
                               int slot, double& t, double& v, double& w) {
    if (!hit_at_all(tree, start, direction, slot, t, v, w)) return false;
    if (!CROSSINGS) refine(tree, start, direction, slot, t, v, w);
    return t >= t_min;
};
