"""C++ text of the exact test of a ray against a triangle, in float64."""

from geokit.mesh._predicates_kernels import EXACT

# Directions shorter than this would lose digits as denormal numbers inside the edge functions.
SHORTEST_DIRECTION = 1e-150

# Twice a triangle's projected area over the squares of its two edges there, below which t is that of the plane.
SLIVER = 1e-3

# Shares of a sliver lose digits along its longest edge, as many as its area is smaller than that edge's square, and t
# would with them. Its plane does not: from the corner between the two shorter edges, with a normal whose components
# are right to a few roundings (Kahan's difference of products), t is off by roundings of the longest edge. It never
# leaves the triangle: where it is seen edge-on, and has no plane to speak of, its longest edge tells. The weights then
# are those of a point that lies as far along that edge as t says.
_SLIVER_HIT = """
    auto difference_of_products = [&](double p, double q, double r, double s) {
        const double rs = product(r, s);
        return plus(fused(p, q, -rs), fused(-r, s, rs));
    };
    // Corners in the sheared frame, depths in units of the direction.
    struct Sheared { double x[3], y[3], depth[3]; };
    auto sliver_hit = [&](const point& start, const point& direction, int slot, const Sheared& seen, double& t,
                          double& v, double& w) OUT_OF_LINE {
        const point p[3] = {tree.corners.data[3 * slot], tree.corners.data[3 * slot + 1],
                            tree.corners.data[3 * slot + 2]};
        const point bc = p[2] - p[1], ca = p[0] - p[2], ab = p[1] - p[0];
        const double bc2 = wp::dot(bc, bc), ca2 = wp::dot(ca, ca), ab2 = wp::dot(ab, ab);
        // The longest edge runs from corner i to corner j.
        const int o = bc2 >= ca2 ? (bc2 >= ab2 ? 0 : 2) : (ca2 >= ab2 ? 1 : 2), i = (o + 1) % 3, j = (o + 2) % 3;
        const point e = p[i] - p[o], f = p[j] - p[o], edge = p[j] - p[i];
        const point normal(difference_of_products(e[1], f[2], e[2], f[1]),
                           difference_of_products(e[2], f[0], e[0], f[2]),
                           difference_of_products(e[0], f[1], e[1], f[0]));
        const double slope = wp::dot(normal, direction), square = wp::dot(edge, edge);
        if (slope != 0.0) {
            t = wp::dot(normal, p[o] - start) / slope;
        } else {
            const double dx = seen.x[j] - seen.x[i], dy = seen.y[j] - seen.y[i], length2 = dx * dx + dy * dy;
            const double along = length2 > 0.0 ? -(seen.x[i] * dx + seen.y[i] * dy) / length2 : 0.5;
            t = seen.depth[i] + wp::min(wp::max(along, 0.0), 1.0) * (seen.depth[j] - seen.depth[i]);
        }
        const double nearest = wp::min(wp::min(seen.depth[0], seen.depth[1]), seen.depth[2]);
        const double farthest = wp::max(wp::max(seen.depth[0], seen.depth[1]), seen.depth[2]);
        t = wp::min(wp::max(t, nearest), farthest);
        if (square == 0.0)
            return;
        const double weight_o = o == 0 ? 1.0 - v - w : o == 1 ? v : w;
        const double along = wp::dot((start - p[i]) + direction * t, edge) / square;
        const double of_j = along + weight_o * wp::dot(e, edge) / square;
        const double weight_j = wp::min(wp::max(of_j, 0.0), 1.0 - weight_o);
        v = o == 1 ? weight_o : j == 1 ? weight_j : 1.0 - weight_o - weight_j;
        w = o == 2 ? weight_o : j == 2 ? weight_j : 1.0 - weight_o - weight_j;
    };
"""

# Edge functions of the two triangles at an edge must be exact negatives of each other: a fused multiply-add would
# round the two products of each differently, and a ray through the edge could miss both (Woop, Benthin, Wald,
# "Watertight Ray/Triangle Intersection", JCGT 2013). Differs: all in float64, no fall-back needed.

# Names that the text expects: tree and t_min. `hit` is false where the ray misses the triangle in a slot; t in units of
# the direction, v and w the weights of b and c.
_HIT = (
    EXACT
    + _SLIVER_HIT
    + """
    auto hit = [&](const point& start, const point& direction, int slot, double& t, double& v, double& w) {
        double size[3] = {direction[0] < 0 ? -direction[0] : direction[0],
                          direction[1] < 0 ? -direction[1] : direction[1],
                          direction[2] < 0 ? -direction[2] : direction[2]};
        // The axis along which the ray moves most becomes z of a sheared frame in which the ray is the z axis.
        const int kz = size[0] >= size[1] ? (size[0] >= size[2] ? 0 : 2) : (size[1] >= size[2] ? 1 : 2);
        const int kx = direction[kz] < 0.0 ? (kz + 2) % 3 : (kz + 1) % 3;
        const int ky = direction[kz] < 0.0 ? (kz + 1) % 3 : (kz + 2) % 3;
        const double sz = 1.0 / direction[kz], sx = direction[kx] * sz, sy = direction[ky] * sz;
        const point a = tree.corners.data[3 * slot] - start, b = tree.corners.data[3 * slot + 1] - start,
                    c = tree.corners.data[3 * slot + 2] - start;
        const double ax = minus(a[kx], product(sx, a[kz])), ay = minus(a[ky], product(sy, a[kz]));
        const double bx = minus(b[kx], product(sx, b[kz])), by = minus(b[ky], product(sy, b[kz]));
        const double cx = minus(c[kx], product(sx, c[kz])), cy = minus(c[ky], product(sy, c[kz]));
        double fa = minus(product(cx, by), product(cy, bx));
        double fb = minus(product(ax, cy), product(ay, cx));
        double fc = minus(product(bx, ay), product(by, ax));
        ON_EDGE
        const double area = fa + fb + fc;
        double whole = area;
        if (whole == 0.0) {
            ON_LINE
        }
        v = fb / whole;
        w = fc / whole;
        t = (fa * a[kz] + fb * b[kz] + fc * c[kz]) * sz / whole;
        const double ux = bx - ax, uy = by - ay, vx = cx - ax, vy = cy - ay;
        if ((area < 0.0 ? -area : area) < SLIVER * ((ux * ux + uy * uy) + (vx * vx + vy * vy))) {
            const Sheared seen = {{ax, bx, cx}, {ay, by, cy}, {a[kz] * sz, b[kz] * sz, c[kz] * sz}};
            sliver_hit(start, direction, slot, seen, t, v, w);
        }
        return t >= t_min;
    };
"""
).replace("SLIVER *", f"{SLIVER} *")

# A ray through an edge or a vertex hits all triangles there: what is closed has no hole.
RAY_HIT = _HIT.replace(
    "ON_EDGE",
    "if ((fa < 0.0 || fb < 0.0 || fc < 0.0) && (fa > 0.0 || fb > 0.0 || fc > 0.0)) return false;",
).replace("ON_LINE", "return false;  // seen edge-on: its neighbours take the ray")

# A ray through an edge or a vertex hits as many triangles there as one moved by an infinitesimal (e, e^2) in x and y
# of the sheared frame: each passage through the surface counts once, a touch from one side twice or not at all
# (Edelsbrunner, Muecke, "Simulation of Simplicity", 1990). Signs are those of the exact determinants of the sheared
# corners, so that they belong to one arrangement of points in the plane and a closed surface is crossed an even number
# of times by any line.
RAY_CROSSING = _HIT.replace(
    "ON_EDGE",
    """
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
        // What rounding left on the wrong side of zero.
        if (fa * ea < 0.0) fa = 0.0;
        if (fb * ea < 0.0) fb = 0.0;
        if (fc * ea < 0.0) fc = 0.0;
""",
).replace("ON_LINE", "fa = fb = fc = 1.0; whole = 3.0;  // hit, at a place that rounding hides")
