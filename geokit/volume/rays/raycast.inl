// The first crossing of the trilinear interpolant with an isovalue along a ray.
//
// Expects field, a RayField; the names of ray_box.inl, raycast_start.inl and raycast_cell.inl. Returns a wp::vec_t of
// four doubles: the ray parameter of the crossing in units of toward, infinite for none, and the interpolant's
// gradient there in index space.
#include "volume/rays/ray_field.inl"
#include "volume/nanovdb/cached_accessor.inl"
#include "volume/rays/ray_box.inl"
#include "volume/rays/ray_steps.inl"
double ta = 0.0, tb = 0.0;
int unseen = -1;
#include "volume/rays/raycast_start.inl"
#define SAME side_of(value) == side_of(other)
#define ON_UNSEEN side = 0;
#define ON_REGION                                                                                                      \
    const int now = side_of(value);                                                                                    \
    if (now == 0 || (now != 2 && now * side < 0)) {                                                                    \
        hit = t0 + ta;                                                                                                 \
        goto done;                                                                                                     \
    }                                                                                                                  \
    side = now == 2 ? 0 : now;
#include "volume/rays/traverse_blocks.inl"
#include "volume/rays/traverse.inl"
#undef SAME
#undef ON_UNSEEN
#undef ON_REGION
#include "volume/rays/raycast_end.inl"
