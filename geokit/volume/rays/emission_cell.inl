// Adds the depth and the emission of a cell; hook ON_CELL of traverse.inl.
//
// Expects the names of traverse.inl and emission.inl.
#define VOXEL(n) (double)c[n]
#include "volume/rays/cubic.inl"
#undef VOXEL
{
    const double d0 = p0, d1 = p1, d2 = p2, d3 = p3;
#include "volume/rays/emission_voxels.inl"
    add(tb - ta, d0, d1, d2, d3, p0, p1, p2, p3);
}
