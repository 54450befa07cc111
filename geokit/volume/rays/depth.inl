// The integral of the trilinear interpolant along a ray, with lengths in units of toward.
//
// Expects field, a RayField; the names of ray_box.inl. Returns the double.
#include "volume/rays/ray_field.inl"
#include "volume/nanovdb/cached_accessor.inl"
#include "volume/rays/ray_box.inl"
#include "volume/rays/ray_steps.inl"
double ta = 0.0, tb = 0.0;
int unseen = -1;
double depth = 0.0;
#define SAME value == other
#define ON_REGION depth += (double)value * (tb - ta);
#include "volume/rays/traverse.inl"
#undef SAME
#undef ON_REGION
return depth;
