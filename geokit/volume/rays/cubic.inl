// The interpolant along a ray in a cell, as a cubic of s, which is 0 at ta and 1 at tb.
#pragma once
#include "volume/rays/ray.inl"

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
