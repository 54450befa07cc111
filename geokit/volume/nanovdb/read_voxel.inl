// Nodes and voxels of grids of any type: see read_voxel_kernels.
#pragma once
#include "volume/nanovdb/elements.inl"

// Where the value of a voxel is stored: the address of the leaf, marked by its lowest bit, which no address has; or of
// the value of the tile or background.
static constexpr auto node_of = [](unsigned long long volume, int grid_type, int i, int j,
                                   int k) -> unsigned long long {
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_coord_t ijk = {i, j, k};
    pnanovdb_readaccessor_t accessor;
    pnanovdb_readaccessor_init(PNANOVDB_REF(accessor), wp::volume::get_root(buf));
    unsigned level;
    const pnanovdb_address_t at = pnanovdb_readaccessor_get_value_address_and_level(
        (pnanovdb_grid_type_t)grid_type, buf, PNANOVDB_REF(accessor), PNANOVDB_REF(ijk), PNANOVDB_REF(level));
    return level == 0u ? accessor.leaf.address.byte_offset | 1u : at.byte_offset;
};

#define COMPONENT(NAME, kind, e) inside ? (double)(LEAF_##kind(NAME, e)) : (double)(TILE_##kind(at, e))
#define NUMBER_CASE(NAME, kind)                                                                                        \
    case PNANOVDB_GRID_TYPE_##NAME: result = COMPONENT(NAME, kind, 0); break;
#define VECTOR_CASE(NAME, kind)                                                                                        \
    case PNANOVDB_GRID_TYPE_##NAME:                                                                                    \
        for (unsigned e = 0u; e < components; ++e) result[e] = COMPONENT(NAME, kind, e);                               \
        break;
// The voxel (i, j, k) of a grid, by the node that holds it: a double or a wp::vec_t of doubles, as `family` is; NaN where
// the grid's type has another number of components.
static constexpr auto read_voxel = [](unsigned long long volume, int grid_type, unsigned long long node, int i, int j,
                                      int k, auto family) {
    constexpr unsigned components = sizeof(family) / 8;
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const bool inside = (node & 1u) != 0u;
    const pnanovdb_address_t at = {node & ~1ull};
    const pnanovdb_leaf_handle_t leaf = {at};
    const pnanovdb_coord_t ijk = {i, j, k};
    const unsigned n = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk));
    wp::half half;
    decltype(family) result = decltype(family)((double)NAN);
    if constexpr (components == 1) {
        switch (grid_type) {
            SCALAR_TYPES(NUMBER_CASE)
        default: break;
        }
    } else if constexpr (components == 3) {
        switch (grid_type) {
            VECTOR3_TYPES(VECTOR_CASE)
        default: break;
        }
    } else {
        switch (grid_type) {
            VECTOR4_TYPES(VECTOR_CASE)
        default: break;
        }
    }
    return result;
};
#undef NUMBER_CASE
#undef VECTOR_CASE
#undef COMPONENT

// The voxels (i, j, k) to (i + 1, j + 1, k + 1) of a float grid, k fastest, all of them in one leaf.
static constexpr auto read_float_leaf_cell = [](unsigned long long volume, unsigned long long node, int i, int j,
                                                int k) -> wp::vec_t<8, double> {
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_leaf_handle_t leaf = {node & ~1ull};
    const pnanovdb_coord_t ijk = {i, j, k};
    const unsigned n = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk));
    wp::vec_t<8, double> result;
    for (unsigned c = 0u; c < 8u; ++c) {
        const unsigned step = ((c & 4u) << 4) + ((c & 2u) << 2) + (c & 1u);
        result[c] = (double)pnanovdb_read_float(
            buf, pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_FLOAT, buf, leaf, n + step));
    }
    return result;
};

// Whether a voxel, or the tile that covers it, is active: PNanoVDB reads the value masks of leaves and tiles and the state
// of the root's tiles.
static constexpr auto is_active = [](unsigned long long volume, int i, int j, int k) -> bool {
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_coord_t ijk = {i, j, k};
    pnanovdb_readaccessor_t accessor;
    pnanovdb_readaccessor_init(PNANOVDB_REF(accessor), wp::volume::get_root(buf));
    return pnanovdb_readaccessor_is_active(wp::volume::get_grid_type(buf), buf, PNANOVDB_REF(accessor),
                                           PNANOVDB_REF(ijk))
           != PNANOVDB_FALSE;
};
