// Adds the integral of the interpolant in a cell to the depth; hook ON_CELL of traverse.inl.
//
// Expects the names of traverse.inl, and depth.
#define VOXEL(n) (double)c[n]
#include "volume/rays/cubic.inl"
#undef VOXEL
depth += (tb - ta) * (p0 + p1 / 2.0 + p2 / 3.0 + p3 / 4.0);
