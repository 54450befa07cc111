// The emission in the cell (bx, by, bz) of the density, as a cubic along the ray.
//
// Expects the names of emission.inl. Defines c and those of cubic.inl.
real_e c[8];
for (int m = 0; m < 8; ++m) {
    const int i = bx + (m >> 2), j = by + (m >> 1 & 1), k = bz + (m & 1);
    c[m] = voxel_e(find_e(i, j, k, ignored_e), i, j, k);
}
#define VOXEL(n) (double)c[n]
#include "volume/rays/cubic.inl"
#undef VOXEL
