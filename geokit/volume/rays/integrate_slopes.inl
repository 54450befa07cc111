// Derivatives of transmittance and emission along a ray.
//
// The derivative by the density at a place is that of all light behind it, and the derivative by the emission is the
// transmittance up to it. In a stretch of the ray (s from 0 to 1) only their integrals times 1, s, s^2 and s^3 are
// needed, because the interpolant and all its derivatives are cubics of s. Of the light within the stretch these are
// sums over the Gauss points of the emission: so this is the exact derivative of the quadrature.
#include "core/atomic.inl"
#include "volume/rays/emission.inl"

struct Slopes {
    Light light;
    // Of a stretch: the integrals of both derivatives, and sums over its Gauss points, times powers of s.
    double of_density[4], of_light[4], passed[4], lit[4];
    // Integrals over the ray of the gradient, of the gradient times the place along the ray, and of the density, each
    // times its derivative; density and emission where the ray ends.
    double along[3], lever[3], stretched, end_density, end_light;
};

// Walks along a ray. `slopes` are the slope by the transmittance times the transmittance, the slope by the emission, and
// the emission; `unit` are world lengths in a unit of toward, `scale` is the extinction times that. The emission is
// needed where it is 0 if its values are `asked` for. Hooks: of_density(grid, cubic) and of_light(grid, cubic), cells of
// the grids when `sum` has their derivatives.
static constexpr auto along_slopes = [](const RayField& field, unsigned long long emission_volume, double scale,
                                        double unit, const wp::vec3d& slopes, bool asked, Ray& ray, Slopes& sum,
                                        auto&& of_density, auto&& of_light) {
    AnyGrid emission = opened(emission_volume, field.anchor, 0.0), density = opened(field.volume, field.anchor, 0.0);
    const double seen = slopes[0], glow = slopes[1], total = slopes[2];
    sum = {};
    auto add = [&](double span, double p0, double p1, double p2, double p3, double e0, double e1, double e2,
                   double e3) {
        add_stretch(sum.light, scale, span, p0, p1, p2, p3, e0, e1, e2, e3,
                    glow == 0.0 || (!asked && is_dark(e0, e1, e2, e3)), [&](double s, double share, double e) {
                        for (int k = 0; k < 4; ++k) {
                            sum.passed[k] += share;
                            share *= s;
                            sum.lit[k] += share * e;
                        }
                    });
        // Light from behind the stretch.
        const double behind = total - unit * sum.light.light;
        for (int k = 0; k < 4; ++k) {
            sum.of_density[k] = -scale * span * (seen + glow * (behind + unit * sum.lit[k])) / (double)(k + 1);
            sum.of_light[k] = glow * unit * sum.passed[k];
            sum.passed[k] = 0.0;
            sum.lit[k] = 0.0;
        }
        sum.stretched +=
            p0 * sum.of_density[0] + p1 * sum.of_density[1] + p2 * sum.of_density[2] + p3 * sum.of_density[3];
        sum.end_density = p0 + p1 + p2 + p3;
        sum.end_light = e0 + e1 + e2 + e3;
    };
    auto lit = [&](const Cubic& e) { of_light(emission, e); };
    along_both(density, emission, ray, add, lit, [&](const Cubic& p) {
        if (glow == 0.0) {
            add(ray.tb - ray.ta, p.p0, p.p1, p.p2, p.p3, 0.0, 0.0, 0.0, 0.0);
        } else {
            const Cubic e = cell_of(emission, ray);
            add(ray.tb - ray.ta, p.p0, p.p1, p.p2, p.p3, e.p0, e.p1, e.p2, e.p3);
            lit(e);
        }
        of_density(density, p);
    });
};

// Adds a cell to the derivatives by the ray; m are the integrals of the derivative times powers of s.
static constexpr auto turn = [](const Ray& ray, const Cubic& c, const double* m, Slopes& sum) {
    auto slope = [&](int axis, double k0, double a0, double a1, double ka, double b0, double b1, double kb) {
        const double c0 = k0 + a0 * ka + b0 * kb + a0 * b0 * c.kxyz,
                     c1 = a1 * ka + b1 * kb + (a0 * b1 + a1 * b0) * c.kxyz, c2 = a1 * b1 * c.kxyz;
        const double here = c0 * m[0] + c1 * m[1] + c2 * m[2];
        sum.along[axis] += here;
        sum.lever[axis] += (ray.t0 + ray.ta) * here + (ray.tb - ray.ta) * (c0 * m[1] + c1 * m[2] + c2 * m[3]);
    };
    slope(0, c.kx, c.ey, c.gy, c.kxy, c.ez, c.gz, c.kxz);
    slope(1, c.ky, c.ex, c.gx, c.kxy, c.ez, c.gz, c.kyz);
    slope(2, c.kz, c.ex, c.gx, c.kxz, c.ey, c.gy, c.kyz);
};

// Gives each voxel of a cell its share: on_share(place, share), by the number of its value in the grid's buffer.
static constexpr auto spread = [](AnyGrid& in, const Ray& ray, const Cubic& c, const double* m, auto&& on_share) {
    for (int n = 0; n < 8; ++n) {
        int ignored;
        const int i = ray.bx + (n >> 2), j = ray.by + (n >> 1 & 1), k = ray.bz + (n & 1);
        const address node = find(in, i, j, k, ignored);
        // Values of tiles are constants; those of inactive voxels are left out when all is added up.
        if (!(node & 1)) continue;
        const double x0 = n & 4 ? c.ex : 1.0 - c.ex, x1 = n & 4 ? c.gx : -c.gx, y0 = n & 2 ? c.ey : 1.0 - c.ey,
                     y1 = n & 2 ? c.gy : -c.gy, z0 = n & 1 ? c.ez : 1.0 - c.ez, z1 = n & 1 ? c.gz : -c.gz;
        const double q0 = x0 * y0, q1 = x0 * y1 + x1 * y0, q2 = x1 * y1;
        const double share = q0 * z0 * m[0] + (q0 * z1 + q1 * z0) * m[1] + (q1 * z1 + q2 * z0) * m[2] + q2 * z1 * m[3];
        if (share == 0.0) continue;
        const int size = in.type == PNANOVDB_GRID_TYPE_FLOAT ? 4 : 8;
        const long long first_of_leaf =
            (long long)((node & ~1ull) + PNANOVDB_GRID_TYPE_GET(in.type, leaf_off_table)) / size;
        on_share(first_of_leaf + ((i & 7) << 6 | (j & 7) << 3 | (k & 7)), share);
    }
};

// Lowers the reciprocal of the largest power of two in the shares of a value.
static constexpr auto measure = [](const wp::array_t<int64_t>& values, long long at, double share) {
#if defined(__CUDA_ARCH__)
    const long long bits = __double_as_longlong(share);
#else
    const long long bits = __builtin_bit_cast(long long, share);
#endif
    // Of a share that is not finite this is negative, less than any other.
    lower_to(values, at, (int64_t)((2046ll << 52) - (bits & 2047ll << 52)));
};

// Adds a share to the sum of its value as a whole number, in any order.
static constexpr auto add_share = [](const wp::array_t<double>& least, const wp::array_t<int64_t>& sums,
                                     long long place, double share) {
    const double by = least.data[place];
    if (!(by > 0.0)) return;
    add_at(sums.data + place, (int64_t)wp::floor(share * by * WHOLE + 0.5));
};

// The derivatives by the ray, and the least reciprocals of the values of both grids. `least` and `least_light` have an
// entry for each value of a grid's buffer, or none if not wanted.
static constexpr auto measure_slopes = [](int i, const RayField& field, unsigned long long emission_volume,
                                          double scale, double unit, const wp::vec3d& slopes, const IndexRay& given,
                                          wp::array_t<wp::vec3d>& out_along, wp::array_t<wp::vec3d>& out_lever,
                                          wp::array_t<wp::vec2d>& out_length, wp::array_t<int64_t>& least,
                                          wp::array_t<int64_t>& least_light) {
    Ray ray = into_box(field.lower, field.upper, given.start, given.toward, given.t_first, given.t_last);
    Slopes sum;
    auto each = [&](AnyGrid& in, const Cubic& c, const double* m, const auto& values) {
        turn(ray, c, m, sum);
        if (values.shape[0] > 0)
            spread(in, ray, c, m, [&](long long place, double share) { measure(values, place, share); });
    };
    along_slopes(
        field, emission_volume, scale, unit, slopes, least_light.shape[0] > 0, ray, sum,
        [&](AnyGrid& in, const Cubic& c) { each(in, c, sum.of_density, least); },
        [&](AnyGrid& in, const Cubic& c) { each(in, c, sum.of_light, least_light); });
    for (int k = 0; k < 3; ++k) {
        out_along.data[i][k] = sum.along[k];
        out_lever.data[i][k] = sum.lever[k];
    }
    out_length.data[i][0] = sum.stretched;
    // Beyond the box all is background, which is 0.
    out_length.data[i][1] =
        ray.left ? 0.0
                 : slopes[1] * unit * wp::exp(-sum.light.depth) * sum.end_light - scale * slopes[0] * sum.end_density;
};

// Adds the shares of the values of both grids.
static constexpr auto add_slopes = [](const RayField& field, unsigned long long emission_volume, double scale,
                                      double unit, const wp::vec3d& slopes, const IndexRay& given,
                                      const wp::array_t<double>& least, const wp::array_t<double>& least_light,
                                      wp::array_t<int64_t>& sums, wp::array_t<int64_t>& sums_light) {
    Ray ray = into_box(field.lower, field.upper, given.start, given.toward, given.t_first, given.t_last);
    Slopes sum;
    auto each = [&](AnyGrid& in, const Cubic& c, const double* m, const auto& values, const auto& to) {
        if (values.shape[0] > 0)
            spread(in, ray, c, m, [&](long long place, double share) { add_share(values, to, place, share); });
    };
    along_slopes(
        field, emission_volume, scale, unit, slopes, least_light.shape[0] > 0, ray, sum,
        [&](AnyGrid& in, const Cubic& c) { each(in, c, sum.of_density, least, sums); },
        [&](AnyGrid& in, const Cubic& c) { each(in, c, sum.of_light, least_light, sums_light); });
};
