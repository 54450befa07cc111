"""C++ text of the exact test of a ray against a triangle, in float64."""

from geokit.mesh._predicates_kernels import EXACT

# Directions shorter than this would lose digits as denormal numbers inside the edge functions.
SHORTEST_DIRECTION = 1e-150

# Edge functions of the two triangles at an edge must be exact negatives of each other: a fused multiply-add would
# round the two products of each differently, and a ray through the edge could miss both (Woop, Benthin, Wald,
# "Watertight Ray/Triangle Intersection", JCGT 2013). Differs: all in float64, no fall-back needed.

# Names that the text expects: tree and t_min. `hit` is false where the ray misses the triangle in a slot; t in units of
# the direction, v and w the weights of b and c.
_HIT = (
    EXACT
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
        double whole = fa + fb + fc;
        if (whole == 0.0) {
            ON_LINE
        }
        v = fb / whole;
        w = fc / whole;
        t = (fa * a[kz] + fb * b[kz] + fc * c[kz]) * sz / whole;
        return t >= t_min;
    };
"""
)

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
