// The voxel (i, j, k) of a grid, as float64, by the node that holds it.
//
// Expects volume, grid_type, i, j, k; node: the address of a leaf, marked by its lowest bit, or of a value; the macro
// COMPONENTS, 1, 3 or 4. Returns a double or a wp::vec_t of doubles; NaN where the grid's type has another number of
// components.
#include "volume/nanovdb/elements.inl"
const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
const bool inside = (node & 1u) != 0u;
const pnanovdb_address_t at = {node & ~1ull};
const pnanovdb_leaf_handle_t leaf = {at};
const pnanovdb_coord_t ijk = {i, j, k};
const unsigned n = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk));
wp::half half;
#define COMPONENT(NAME, kind, e) inside ? (double)(LEAF_##kind(NAME, e)) : (double)(TILE_##kind(at, e))
#if COMPONENTS == 1
#define VOXEL_CASE(NAME, kind)                                                                                         \
case PNANOVDB_GRID_TYPE_##NAME: result = COMPONENT(NAME, kind, 0); break;
double result;
switch (grid_type) {
    SCALAR_TYPES(VOXEL_CASE)
default: result = (double)NAN;
}
#else
#if COMPONENTS == 3
#define TYPES VECTOR3_TYPES
#else
#define TYPES VECTOR4_TYPES
#endif
#define VOXEL_CASE(NAME, kind)                                                                                         \
case PNANOVDB_GRID_TYPE_##NAME:                                                                                        \
    for (unsigned e = 0u; e < COMPONENTS; ++e) result[e] = COMPONENT(NAME, kind, e);                                   \
    break;
wp::vec_t<COMPONENTS, double> result;
switch (grid_type) {
    TYPES(VOXEL_CASE)
default:
    for (unsigned e = 0u; e < COMPONENTS; ++e) result[e] = (double)NAN;
}
#undef TYPES
#endif
#undef VOXEL_CASE
#undef COMPONENT
return result;
