// The interpolant along a ray in a cell, as a cubic of s, which is 0 at ta and 1 at tb.
//
// Expects the names of traverse.inl, and VOXEL(n), a voxel of the cell as double. Defines the coefficients p0 to p3;
// the ray's position (ex, ey, ez) on entering the cell and its displacement (gx, gy, gz) in it; the interpolant's
// coefficients kx to kxyz.
const double ex = (qx - (double)bx) + ta * dx, ey = (qy - (double)by) + ta * dy, ez = (qz - (double)bz) + ta * dz;
const double gx = (tb - ta) * dx, gy = (tb - ta) * dy, gz = (tb - ta) * dz;
const double low = VOXEL(0), kx = VOXEL(4) - low, ky = VOXEL(2) - low, kz = VOXEL(1) - low;
const double kxy = (VOXEL(6) - VOXEL(2)) - kx, kxz = (VOXEL(5) - VOXEL(1)) - kx, kyz = (VOXEL(3) - VOXEL(1)) - ky;
const double kxyz = ((VOXEL(7) - VOXEL(3)) - (VOXEL(5) - VOXEL(1))) - kxy;
const double mx = kx + ey * kxy, my = ky + ez * kyz, mz = kz + ex * kxz;
double p0 = (low + ex * mx + ey * my + ez * mz) + ex * ey * ez * kxyz;
const double p1 =
    gx * (mx + ez * (kxz + ey * kxyz)) + gy * (my + ex * (kxy + ez * kxyz)) + gz * (mz + ey * (kyz + ex * kxyz));
const double p2 = gx * gy * (kxy + ez * kxyz) + gx * gz * (kxz + ey * kxyz) + gy * gz * (kyz + ex * kxyz);
const double p3 = gx * gy * gz * kxyz;
