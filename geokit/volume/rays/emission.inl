// Optical depth along a ray, which is `scale` times the integral of the density, and the integral of the emission that
// reaches the ray's start. Both grids have the same transform.
#pragma once
#include "volume/rays/ray.inl"
#include "volume/rays/traverse.inl"

struct Light {
    double depth, light;
};

// The cubic along the ray in its cell of a grid.
static constexpr auto cell_of = [](AnyGrid& in, const Ray& ray) -> Cubic {
    double c[8];
    for (int m = 0; m < 8; ++m) {
        int ignored;
        const int i = ray.bx + (m >> 2), j = ray.by + (m >> 1 & 1), k = ray.bz + (m & 1);
        c[m] = voxel(in, find(in, i, j, k, ignored), i, j, k);
    }
    return cubic_of(ray, [&](int n) { return c[n]; });
};

// Without emission a stretch needs no quadrature.
static constexpr auto is_dark = [](double e0, double e1, double e2, double e3) -> bool {
    return e0 == 0.0 && e1 == 0.0 && e2 == 0.0 && e3 == 0.0;
};

// Adds a stretch of the ray: emission e0 to e3 and density p0 to p3 are cubics of s, which is 0 and 1 at its ends.
// Hooks: `dark`, whether it needs no quadrature; on_light(s, weight, emission), at each Gauss point, with its weight
// times the transmittance.
static constexpr auto add_stretch = [](Light& sum, double scale, double span, double p0, double p1, double p2,
                                       double p3, double e0, double e1, double e2, double e3, bool dark,
                                       auto&& on_light) {
    const double to_depth = scale * span;
    auto depth_at = [&](double s) { return to_depth * s * (p0 + s * (p1 / 2.0 + s * (p2 / 3.0 + s * p3 / 4.0))); };
    const double all = depth_at(1.0);
    const double node[6] = {0.03376524289842403, 0.16939530676686776, 0.38069040695840156,
                            0.6193095930415985,  0.8306046932331322,  0.9662347571015759};
    const double weight[6] = {0.08566224618958514, 0.18038078652406936, 0.23395696728634552,
                              0.23395696728634552, 0.18038078652406936, 0.08566224618958514};
    double from = 0.0, step = 1.0, before = 0.0;
    while (!dark && from < 1.0 && sum.depth + before < OPAQUE) {
        step = wp::min(step, 1.0 - from);
        double after = depth_at(from + step);
        while (wp::abs(after - before) > STEP_DEPTH && step > SHORTEST_STEP) {
            step *= 0.5;
            after = depth_at(from + step);
        }
        for (int g = 0; g < 6; ++g) {
            const double s = from + step * node[g], through = wp::exp(-(sum.depth + depth_at(s)));
            const double emission = e0 + s * (e1 + s * (e2 + s * e3));
            sum.light += span * step * weight[g] * emission * through;
            on_light(s, span * step * weight[g] * through, emission);
        }
        from += step;
        step *= 2.0;
        before = after;
        // With a depth of NaN the loop would never end.
        dark = !(after == after);
    }
    sum.depth += all;
};

// Crosses a region of constant density, cell by cell of the emission. Hooks: add, which adds a stretch, from its length
// on; on_light_cell(cubic), behind each cell where the emission is not constant.
static constexpr auto cross_region = [](AnyGrid& emission, Ray& ray, double even, auto&& add, auto&& on_light_cell) {
    const double qx = ray.qx, qy = ray.qy, qz = ray.qz, dx = ray.dx, dy = ray.dy, dz = ray.dz;
    const int fx = ray.fx, fy = ray.fy, fz = ray.fz;
    int &bx = ray.bx, &by = ray.by, &bz = ray.bz;
    double &ta = ray.ta, &tb = ray.tb;
    const double end = tb, began = ta;
    const int kept_x = bx, kept_y = by, kept_z = bz;
    while (ta <= end) {
        int size;
        const address node = find(emission, bx, by, bz, size);
        int ex0 = bx - ((int)((unsigned)bx + (unsigned)emission.anchor[0]) & (size - 1)),
            ey0 = by - ((int)((unsigned)by + (unsigned)emission.anchor[1]) & (size - 1)),
            ez0 = bz - ((int)((unsigned)bz + (unsigned)emission.anchor[2]) & (size - 1));
        int cells = size - 1;
        const bool is_even = !(node & 1) && bx - ex0 < cells && by - ey0 < cells && bz - ez0 < cells;
        if (!is_even) {
            ex0 = bx;
            ey0 = by;
            ez0 = bz;
            cells = 1;
        }
        const double ux = ((double)ex0 + fx * cells - qx) * ray.ix, uy = ((double)ey0 + fy * cells - qy) * ray.iy,
                     uz = ((double)ez0 + fz * cells - qz) * ray.iz;
        const bool by_x = ux <= uy && ux <= uz, by_y = !by_x && uy <= uz;
        const double leave = wp::max(ta, by_x ? ux : by_y ? uy : uz);
        tb = wp::min(leave, end);
        if (is_even) {
            add(tb - ta, even, 0.0, 0.0, 0.0, voxel(emission, node, bx, by, bz), 0.0, 0.0, 0.0);
        } else {
            const Cubic e = cell_of(emission, ray);
            add(tb - ta, even, 0.0, 0.0, 0.0, e.p0, e.p1, e.p2, e.p3);
            on_light_cell(e);
        }
        ta = leave;
        if (!(ta <= end)) break;
        bx = by_x ? (fx ? ex0 + cells : ex0 - 1) : within(qx + ta * dx, ex0, cells);
        by = by_y ? (fy ? ey0 + cells : ey0 - 1) : within(qy + ta * dy, ey0, cells);
        bz = !(by_x || by_y) ? (fz ? ez0 + cells : ez0 - 1) : within(qz + ta * dz, ez0, cells);
    }
    ta = began;
    tb = end;
    bx = kept_x;
    by = kept_y;
    bz = kept_z;
};

// Walks along a ray through both grids. Further hook: on_cell(density), a cell where the density is not constant.
static constexpr auto along_both = [](AnyGrid& density, AnyGrid& emission, Ray& ray, auto&& add, auto&& on_light_cell,
                                      auto&& on_cell) {
    traverse(
        density, ray, [](double value, double other) { return value == other; },
        [&](double value) {
            cross_region(emission, ray, value, add, on_light_cell);
            return false;
        },
        [&](const double* c, bool) {
            on_cell(cubic_of(ray, [&](int n) { return c[n]; }));
            return false;
        });
};

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
