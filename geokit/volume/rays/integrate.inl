// Optical depth and emission along rays.
#include "volume/rays/emission.inl"

// The integral of the trilinear interpolant along a ray, with lengths in units of its direction. Of a grid of floats if
// `family` is one.
static constexpr auto optical_depth = [](const RayField& field, const IndexRay& given, auto family) -> double {
    typedef decltype(family + family) real;
    auto in = opened(field.volume, field.anchor, real());
    Ray ray = into_box(field.lower, field.upper, given.start, given.toward, given.t_first, given.t_last);
    double depth = 0.0;
    traverse(
        in, ray, [](real value, real other) { return value == other; },
        [&](real value) {
            depth += (double)value * (ray.tb - ray.ta);
            return false;
        },
        [&](const real* c, bool) {
            const Cubic p = cubic_of(ray, [&](int n) { return (double)c[n]; });
            depth += (ray.tb - ray.ta) * (p.p0 + p.p1 / 2.0 + p.p2 / 3.0 + p.p3 / 4.0);
            return false;
        });
    return depth;
};

// The optical depth, and the emission that reaches the ray's start.
static constexpr auto depth_and_emission = [](const RayField& field, unsigned long long emission_volume, double scale,
                                              const IndexRay& given) -> wp::vec2d {
    AnyGrid emission = opened(emission_volume, field.anchor, 0.0), density = opened(field.volume, field.anchor, 0.0);
    Ray ray = into_box(field.lower, field.upper, given.start, given.toward, given.t_first, given.t_last);
    Light sum = {0.0, 0.0};
    auto add = [&](double span, double p0, double p1, double p2, double p3, double e0, double e1, double e2,
                   double e3) {
        add_stretch(sum, scale, span, p0, p1, p2, p3, e0, e1, e2, e3, is_dark(e0, e1, e2, e3),
                    [](double, double, double) {});
    };
    along_both(
        density, emission, ray, add, [](const Cubic&) {},
        [&](const Cubic& p) {
            const Cubic e = cell_of(emission, ray);
            add(ray.tb - ray.ta, p.p0, p.p1, p.p2, p.p3, e.p0, e.p1, e.p2, e.p3);
        });
    return wp::vec2d(sum.depth, sum.light);
};
