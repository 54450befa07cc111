// A cell of the density, with the emission in it; hook ON_CELL of traverse.inl.
//
// Expects the names of traverse.inl and emission.inl.
#define VOXEL(n) (double)c[n]
#include "volume/rays/cubic.inl"
#undef VOXEL
if (glow == 0.0) {
    add(tb - ta, p0, p1, p2, p3, 0.0, 0.0, 0.0, 0.0);
} else {
    const double d0 = p0, d1 = p1, d2 = p2, d3 = p3;
#include "volume/rays/emission_voxels.inl"
    add(tb - ta, d0, d1, d2, d3, p0, p1, p2, p3);
#include "volume/rays/emission_slopes_light_cell.inl"
}
#define MOMENTS of_density
#define FIND find
#define GRID_TYPE grid_type
#define LEAST least
#define SUMS sums
#include "volume/rays/emission_slopes_spread.inl"
#undef MOMENTS
#undef FIND
#undef GRID_TYPE
#undef LEAST
#undef SUMS
