// A ray in index space, relative to the anchor voxel, the box outside of which all is background, and the interpolant
// along the ray in a cell.
#pragma once

struct Ray {
    // Where the ray enters the box, the direction, whose largest component is 1, and reciprocals.
    double qx, qy, qz, dx, dy, dz, ix, iy, iz;
    // The first and last t; the ray enters the box at t0, and its end there is t0 + last.
    double t_first, t_last, t0, last;
    // Signs; 1 for forwards, else 0.
    int sx, sy, sz, fx, fy, fz;
    // Whether the ray comes from outside the box, and whether it leaves it before t_last.
    bool crosses, entered, left;
    // A walk is between ta and tb, relative to t0, in the cell (bx, by, bz). `unseen` is -1; or, if the ray comes from
    // blocks or cells whose voxels it did not read, the number of a voxel of the face where it left them.
    int bx, by, bz, unseen;
    double ta, tb;
};

// Clips a ray to the box and puts it into its first cell. There are no branches, so that the text also serves several
// rays in SIMD.
static constexpr auto into_box = [](const auto& lower, const auto& upper, const auto& start, const auto& toward,
                                    double t_first, double t_last) -> Ray {
    const double qx0 = start[0], qy0 = start[1], qz0 = start[2];
    // Such a small component moves the ray by less than 2^-60 voxels within the range of int32.
    const double dx = wp::abs(toward[0]) < 1e-30 ? 0.0 : toward[0], dy = wp::abs(toward[1]) < 1e-30 ? 0.0 : toward[1],
                 dz = wp::abs(toward[2]) < 1e-30 ? 0.0 : toward[2];
    // For a zero component the reciprocal puts borders out of reach.
    const double ix = dx == 0.0 ? 1e300 : 1.0 / dx, iy = dy == 0.0 ? 1e300 : 1.0 / dy,
                 iz = dz == 0.0 ? 1e300 : 1.0 / dz;
    const int sx = dx < 0.0 ? -1 : 1, sy = dy < 0.0 ? -1 : 1, sz = dz < 0.0 ? -1 : 1;
    const int fx = sx > 0 ? 1 : 0, fy = sy > 0 ? 1 : 0, fz = sz > 0 ? 1 : 0;
    double t0 = t_first, t1 = t_last;
    auto clip = [&](double at, double d, double inverse, double low, double high) {
        const double one = (low - at) * inverse, other = (high - at) * inverse;
        const double begin = wp::max(t0, wp::min(one, other)), end = wp::min(t1, wp::max(one, other));
        const bool beside = !(at >= low && at <= high);
        t0 = d == 0.0 ? t0 : begin;
        t1 = d != 0.0 ? end : beside ? -(double)INFINITY : t1;
    };
    clip(qx0, dx, ix, lower[0], upper[0]);
    clip(qy0, dy, iy, lower[1], upper[1]);
    clip(qz0, dz, iz, lower[2], upper[2]);
    // A number minus itself is zero, unless it is infinite or NaN.
    const double none = (qx0 - qx0) + (qy0 - qy0) + (qz0 - qz0) + (dx - dx) + (dy - dy) + (dz - dz);
    const bool crosses = t0 <= t1 && t0 < (double)INFINITY && lower[0] < upper[0] && none == 0.0;
    const bool entered = !crosses || t0 > t_first;
    if (!crosses) t0 = t_first;
    // From here on the ray starts where it enters the box, so that far origins cost no digits within it.
    auto enter = [&](double at, double d, double low, double high) {
        return wp::min(wp::max(t0 == 0.0 ? at : at + t0 * d, low), high);
    };
    const double qx = enter(qx0, dx, lower[0], upper[0]), qy = enter(qy0, dy, lower[1], upper[1]),
                 qz = enter(qz0, dz, lower[2], upper[2]);
    const double out = wp::min(((fx ? upper[0] : lower[0]) - qx) * ix,
                               wp::min(((fy ? upper[1] : lower[1]) - qy) * iy, ((fz ? upper[2] : lower[2]) - qz) * iz));
    const double last = wp::min(out, t_last - t0);
    const bool left = !crosses || out < t_last - t0;
    // On its upper side the box ends with a cell, not with the voxel beyond it.
    const int bx = (int)(crosses ? wp::min(wp::floor(qx), upper[0] - 1.0) : 0.0);
    const int by = (int)(crosses ? wp::min(wp::floor(qy), upper[1] - 1.0) : 0.0);
    const int bz = (int)(crosses ? wp::min(wp::floor(qz), upper[2] - 1.0) : 0.0);
    return {qx, qy, qz, dx, dy, dz,      ix,      iy,   iz, t_first, t_last, t0, last, sx,
            sy, sz, fx, fy, fz, crosses, entered, left, bx, by,      bz,     -1, 0.0,  0.0};
};

// The cell around a coordinate, clamped to the `count` cells from `low` on, because rounding may miss them.
static constexpr auto within = [](double at, int low, int count) -> int {
    const double above = at - (double)low;
    return low + (above < 0.0 ? 0 : above >= (double)count ? count - 1 : (int)above);
};
// The next border is unpredictable, so a conditional move is faster than a branch.
#if defined(__clang__) && !defined(__CUDA_ARCH__)
static constexpr auto pick = [](bool which, auto one, auto other) {
    return __builtin_unpredictable(which) ? one : other;
};
#else
static constexpr auto pick = [](bool which, auto one, auto other) { return which ? one : other; };
#endif

// The interpolant in a cell as a cubic of s, which is 0 at ta and 1 at tb.
struct Cubic {
    double p0, p1, p2, p3;
    // The ray's position on entering the cell and its displacement in it; the interpolant's coefficients.
    double ex, ey, ez, gx, gy, gz, kx, ky, kz, kxy, kxz, kyz, kxyz;
};

// c(n) is a voxel of the cell as double, k fastest.
static constexpr auto cubic_of = [](const Ray& ray, auto&& c) -> Cubic {
    const double ta = ray.ta, tb = ray.tb, dx = ray.dx, dy = ray.dy, dz = ray.dz;
    const double ex = (ray.qx - (double)ray.bx) + ta * dx, ey = (ray.qy - (double)ray.by) + ta * dy,
                 ez = (ray.qz - (double)ray.bz) + ta * dz;
    const double gx = (tb - ta) * dx, gy = (tb - ta) * dy, gz = (tb - ta) * dz;
    const double low = c(0), kx = c(4) - low, ky = c(2) - low, kz = c(1) - low;
    const double kxy = (c(6) - c(2)) - kx, kxz = (c(5) - c(1)) - kx, kyz = (c(3) - c(1)) - ky;
    const double kxyz = ((c(7) - c(3)) - (c(5) - c(1))) - kxy;
    const double mx = kx + ey * kxy, my = ky + ez * kyz, mz = kz + ex * kxz;
    const double p0 = (low + ex * mx + ey * my + ez * mz) + ex * ey * ez * kxyz;
    const double p1 =
        gx * (mx + ez * (kxz + ey * kxyz)) + gy * (my + ex * (kxy + ez * kxyz)) + gz * (mz + ey * (kyz + ex * kxyz));
    const double p2 = gx * gy * (kxy + ez * kxyz) + gx * gz * (kxz + ey * kxyz) + gy * gz * (kyz + ex * kxyz);
    const double p3 = gx * gy * gz * kxyz;
    return {p0, p1, p2, p3, ex, ey, ez, gx, gy, gz, kx, ky, kz, kxy, kxz, kyz, kxyz};
};
