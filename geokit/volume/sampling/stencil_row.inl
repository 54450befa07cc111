// Rows of stencils of grids of any type: see stencil_kernels.
#include "volume/nanovdb/read_voxel.inl"
#if COMPONENTS == 1
#define TYPES SCALAR_TYPES
#define ROW(e) row[q]
#define CENTER(e) center
#else
#if COMPONENTS == 3
#define TYPES VECTOR3_TYPES
#else
#define TYPES VECTOR4_TYPES
#endif
#define ROW(e) row.data[e][q]
#define CENTER(e) center[e]
#endif
#define EACH for (unsigned e = 0u; e < COMPONENTS; ++e)

// Differences of the voxels (i, j, k) to (i, j, k + count - 1), 4 at most, from a value. near and far are the nodes of
// the first `cut` voxels and of the others: the address of a leaf, with its lowest bit set, or of a tile's value. A row
// of four doubles for each component, 0 beyond `count`; NaN where the grid's type has another number of components.
static constexpr auto read_row = [](unsigned long long volume, int grid_type, unsigned long long near,
                                    unsigned long long far, int i, int j, int k, int cut, int count,
                                    const auto& center) {
#if COMPONENTS == 1
    wp::vec_t<4, double> row;
#else
    wp::mat_t<COMPONENTS, 4, double> row;
#endif
#define LEAF_CASE(NAME, kind)                                                                                          \
    case PNANOVDB_GRID_TYPE_##NAME:                                                                                    \
        for (int q = begin; q < end; ++q) {                                                                            \
            ijk.z = k + q;                                                                                             \
            const unsigned n = first + q;                                                                              \
            EACH ROW(e) = (double)(LEAF_##kind(NAME, e)) - CENTER(e);                                                  \
        }                                                                                                              \
        break;
#define TILE_CASE(NAME, kind)                                                                                          \
    case PNANOVDB_GRID_TYPE_##NAME:                                                                                    \
        for (int q = begin; q < end; ++q) EACH ROW(e) = (double)(TILE_##kind(leaf.address, e)) - CENTER(e);            \
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
                for (int q = begin; q < end; ++q) EACH ROW(e) = (double)NAN;
            }
        } else {
            switch (grid_type) {
                TYPES(TILE_CASE)
            default:
                for (int q = begin; q < end; ++q) EACH ROW(e) = (double)NAN;
            }
        }
    }
    return row;
};
#undef TYPES
#undef ROW
#undef CENTER
#undef EACH
#undef LEAF_CASE
#undef TILE_CASE
