// Clips a ray to the box outside of which all is background. There are no branches, so that the text also serves
// several rays in SIMD.
//
// Expects lower and upper (double: the box), start and toward (double, index space relative to the anchor; the
// largest component of toward is 1), t_first and t_last (units of toward).
// Defines t0, where the ray enters the box, and its end t0 + last; the start (qx, qy, qz) there, the direction (dx,
// dy, dz), reciprocals (ix, iy, iz), signs (sx, sy, sz) and fx, fy, fz, 1 for forwards; the first cell (bx, by, bz);
// crosses; entered, whether the ray comes from outside the box; left, whether it leaves the box before t_last.
const double qx0 = start[0], qy0 = start[1], qz0 = start[2];
// Such a small component moves the ray by less than 2^-60 voxels within the range of int32.
const double dx = wp::abs(toward[0]) < 1e-30 ? 0.0 : toward[0], dy = wp::abs(toward[1]) < 1e-30 ? 0.0 : toward[1],
             dz = wp::abs(toward[2]) < 1e-30 ? 0.0 : toward[2];
// For a zero component the reciprocal puts borders out of reach.
const double ix = dx == 0.0 ? 1e300 : 1.0 / dx, iy = dy == 0.0 ? 1e300 : 1.0 / dy, iz = dz == 0.0 ? 1e300 : 1.0 / dz;
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
bool crosses = t0 <= t1 && t0 < (double)INFINITY && lower[0] < upper[0] && none == 0.0;
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
int bx = (int)(crosses ? wp::min(wp::floor(qx), upper[0] - 1.0) : 0.0);
int by = (int)(crosses ? wp::min(wp::floor(qy), upper[1] - 1.0) : 0.0);
int bz = (int)(crosses ? wp::min(wp::floor(qz), upper[2] - 1.0) : 0.0);
