// Differences of the voxels (i, j, k) to (i, j, k + count - 1) from a value: a row of a stencil along the last axis.
//
// Expects volume, grid_type, i, j, k, count (4 at most), center; near and far, the nodes of the first `cut` voxels
// and of the others (the address of a leaf, with its lowest bit set, or of a tile's value); the macro COMPONENTS, 1,
// 3 or 4. Returns a row of four doubles for each component, 0 beyond `count`; NaN where the grid's type has another
// number of components.
#include "volume/nanovdb/elements.inl"
#if COMPONENTS == 1
wp::vec_t<4, double> row;
#define TYPES SCALAR_TYPES
#define STORE_LEAF(NAME, kind) row[q] = (double)(LEAF_##kind(NAME, 0)) - center;
#define STORE_TILE(kind) row[q] = (double)(TILE_##kind(leaf.address, 0)) - center;
#define STORE_NAN row[q] = (double)NAN;
#else
wp::mat_t<COMPONENTS, 4, double> row;
#if COMPONENTS == 3
#define TYPES VECTOR3_TYPES
#else
#define TYPES VECTOR4_TYPES
#endif
#define EACH(value)                                                                                                    \
    for (unsigned e = 0u; e < COMPONENTS; ++e) row.data[e][q] = value;
#define STORE_LEAF(NAME, kind) EACH((double)(LEAF_##kind(NAME, e)) - center[e])
#define STORE_TILE(kind) EACH((double)(TILE_##kind(leaf.address, e)) - center[e])
#define STORE_NAN EACH((double)NAN)
#endif
#define LEAF_CASE(NAME, kind)                                                                                          \
    case PNANOVDB_GRID_TYPE_##NAME:                                                                                    \
        for (int q = begin; q < end; ++q) {                                                                            \
            ijk.z = k + q;                                                                                             \
            const unsigned n = first + q;                                                                              \
            STORE_LEAF(NAME, kind)                                                                                     \
        }                                                                                                              \
        break;
#define TILE_CASE(NAME, kind)                                                                                          \
    case PNANOVDB_GRID_TYPE_##NAME:                                                                                    \
        for (int q = begin; q < end; ++q) { STORE_TILE(kind) }                                                         \
        break;
const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
wp::half half;
pnanovdb_coord_t ijk = {i, j, k};
const int parts = cut < count ? 2 : 1;
for (int part = 0; part < parts; ++part) {
    const int begin = part ? cut : 0;
    const int end = part ? count : cut;
    const unsigned long long node = part ? far : near;
    const pnanovdb_leaf_handle_t leaf = {node & ~1ull};
    ijk.z = k + begin;
    // Voxels of a row are contiguous.
    const unsigned first = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk)) - (unsigned)begin;
    if (node & 1u) {
        switch (grid_type) {
            TYPES(LEAF_CASE)
        default:
            for (int q = begin; q < end; ++q) { STORE_NAN }
        }
    } else {
        switch (grid_type) {
            TYPES(TILE_CASE)
        default:
            for (int q = begin; q < end; ++q) { STORE_NAN }
        }
    }
}
#undef TYPES
#undef EACH
#undef STORE_LEAF
#undef STORE_TILE
#undef STORE_NAN
#undef LEAF_CASE
#undef TILE_CASE
return row;
