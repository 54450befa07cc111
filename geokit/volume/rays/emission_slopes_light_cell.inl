// A cell of the emission; hook ON_LIGHT_CELL of emission.inl.
#define MOMENTS of_light
#define FIND find_e
#define GRID_TYPE grid_type_e
#define LEAST least_light
#define SUMS sums_light
#include "volume/rays/emission_slopes_spread.inl"
#undef MOMENTS
#undef FIND
#undef GRID_TYPE
#undef LEAST
#undef SUMS
