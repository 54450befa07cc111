// Adds a cell to the derivatives by the ray (RAYS is 1), or to those by its voxels.
//
// Expects the names of cubic.inl for the cell; MOMENTS, the integrals of the derivative times powers of s; FIND and
// GRID_TYPE of the grid; LEAST and SUMS, arrays with an entry for each value of its buffer, of length 0 if not wanted;
// and ON_SHARE, a file that takes the share of the value at `place`.
{
    const double* m = MOMENTS;
#if RAYS
    auto slope = [&](int axis, double k0, double a0, double a1, double ka, double b0, double b1, double kb) {
        const double c0 = k0 + a0 * ka + b0 * kb + a0 * b0 * kxyz, c1 = a1 * ka + b1 * kb + (a0 * b1 + a1 * b0) * kxyz,
                     c2 = a1 * b1 * kxyz;
        const double here = c0 * m[0] + c1 * m[1] + c2 * m[2];
        along[axis] += here;
        lever[axis] += (t0 + ta) * here + (tb - ta) * (c0 * m[1] + c1 * m[2] + c2 * m[3]);
    };
    slope(0, kx, ey, gy, kxy, ez, gz, kxz);
    slope(1, ky, ex, gx, kxy, ez, gz, kyz);
    slope(2, kz, ex, gx, kxz, ey, gy, kyz);
#endif
    for (int n = 0; n < 8 && LEAST.shape[0] > 0; ++n) {
        const int i = bx + (n >> 2), j = by + (n >> 1 & 1), k = bz + (n & 1);
        const unsigned long long node = FIND(i, j, k, ignored);
        // Values of tiles are constants; those of inactive voxels are left out when all is added up.
        if (!(node & 1)) continue;
        const double x0 = n & 4 ? ex : 1.0 - ex, x1 = n & 4 ? gx : -gx, y0 = n & 2 ? ey : 1.0 - ey,
                     y1 = n & 2 ? gy : -gy, z0 = n & 1 ? ez : 1.0 - ez, z1 = n & 1 ? gz : -gz;
        const double q0 = x0 * y0, q1 = x0 * y1 + x1 * y0, q2 = x1 * y1;
        const double share = q0 * z0 * m[0] + (q0 * z1 + q1 * z0) * m[1] + (q1 * z1 + q2 * z0) * m[2] + q2 * z1 * m[3];
        if (share == 0.0) continue;
        const int size = GRID_TYPE == PNANOVDB_GRID_TYPE_FLOAT ? 4 : 8;
        const long long first_of_leaf =
            (long long)((node & ~1ull) + PNANOVDB_GRID_TYPE_GET(GRID_TYPE, leaf_off_table)) / size;
        const long long place = first_of_leaf + ((i & 7) << 6 | (j & 7) << 3 | (k & 7));
#include ON_SHARE
    }
}
