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
//
// Expects exact_arithmetic.inl; tree; optionally the macro CROSSINGS. Defines pick(point, axis) and hit_at_all(start,
// direction, slot, t, v, w): false if the line misses the triangle in a slot; t in units of the direction, v and w the
// weights of b and c.
#if defined(__CUDA_ARCH__)
// A GPU can index only memory: an index that is not known at compile time would keep all points there.
auto pick = [&](const point& p, int k) { return k == 0 ? p[0] : k == 1 ? p[1] : p[2]; };
#else
auto pick = [&](const point& p, int k) { return p[k]; };
#endif
auto hit_at_all = [&](const point& start, const point& direction, int slot, double& t, double& v, double& w) {
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
    #if defined(CROSSINGS)
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
    #else
    if ((fa < 0.0 || fb < 0.0 || fc < 0.0) && (fa > 0.0 || fb > 0.0 || fc > 0.0)) return false;
    #endif
    double whole = fa + fb + fc;
    if (whole == 0.0) {
        #if defined(CROSSINGS)
        fa = fb = fc = 1.0;
        whole = 3.0;  // hit, at a place that rounding hides
        #else
        return false;  // seen edge-on: its neighbors take the ray
        #endif
    }
    v = fb / whole;
    w = fc / whole;
    t = (fa * a[2] + fb * b[2] + fc * c[2]) * sz / whole;
    return true;
};
