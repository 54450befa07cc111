// Nodes and voxels of grids of any type: see read_voxel_kernels.
#pragma once

// Macros that read the numbers that voxels consist of, for all value types.
//
// Expects, where the macros are used: buf; for LEAF_*: leaf (its handle), n (number of the voxel in the leaf), ijk
// (pnanovdb_coord_t, the voxel), half (wp::half).
// Defines LEAF_<kind>(NAME, e): component e of voxel n of the leaf; TILE_<kind>(at, e): component e of the value at
// an address, of a tile or the background; and the lists SCALAR_TYPES, VECTOR3_TYPES, VECTOR4_TYPES of X(NAME, kind),
// where NAME is the end of PNanoVDB's name of a grid type.
// clang-format off
#define SCALAR_TYPES(X)                                                                         \
    X(FLOAT, float) X(DOUBLE, double) X(HALF, half) X(FP4, fp4) X(FP8, fp8) X(FP16, fp16) X(FPN, fpn) \
    X(INT16, int16) X(INT32, int32) X(INT64, int64) X(UINT8, uint8) X(UINT32, uint32)           \
    X(BOOLEAN, bit) X(MASK, mask)
// clang-format on
#define VECTOR3_TYPES(X) X(VEC3F, float) X(VEC3D, double) X(VEC3U8, uint8) X(VEC3U16, uint16)
#define VECTOR4_TYPES(X) X(VEC4F, float) X(VEC4D, double) X(RGBA8, uint8)

// One element at an address. PNanoVDB's 16-bit read leaves the neighboring element in the upper half.
#define ELEMENT_float(at) pnanovdb_read_float(buf, at)
#define ELEMENT_double(at) pnanovdb_read_double(buf, at)
#define ELEMENT_int16(at) (short)(unsigned short)(pnanovdb_read_uint16(buf, at) & 0xffffu)
#define ELEMENT_int32(at) pnanovdb_read_int32(buf, at)
#define ELEMENT_int64(at) pnanovdb_read_int64(buf, at)
#define ELEMENT_uint8(at) pnanovdb_read_uint8(buf, at)
#define ELEMENT_uint16(at) (unsigned short)(pnanovdb_read_uint16(buf, at) & 0xffffu)
#define ELEMENT_uint32(at) pnanovdb_read_uint32(buf, at)
#define ELEMENT_half(at) (half.u = (unsigned short)(pnanovdb_read_uint16(buf, at) & 0xffffu), wp::half_to_float(half))
// Element e of those that begin at an address, each of so many bytes.
#define ELEMENT(kind, bytes, at, e) ELEMENT_##kind(pnanovdb_address_offset(at, bytes* e))
#define TABLE(NAME, number) pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_##NAME, buf, leaf, number)

#define TILE_float(at, e) ELEMENT(float, 4u, at, e)
#define TILE_double(at, e) ELEMENT(double, 8u, at, e)
#define TILE_int16(at, e) ELEMENT(int16, 2u, at, e)
#define TILE_int32(at, e) ELEMENT(int32, 4u, at, e)
#define TILE_int64(at, e) ELEMENT(int64, 8u, at, e)
#define TILE_uint8(at, e) ELEMENT(uint8, 1u, at, e)
#define TILE_uint16(at, e) ELEMENT(uint16, 2u, at, e)
#define TILE_uint32(at, e) ELEMENT(uint32, 4u, at, e)
#define TILE_half(at, e) ELEMENT(half, 2u, at, e)
#define LEAF_float(NAME, e) TILE_float(TABLE(NAME, n), e)
#define LEAF_double(NAME, e) TILE_double(TABLE(NAME, n), e)
#define LEAF_int16(NAME, e) TILE_int16(TABLE(NAME, n), e)
#define LEAF_int32(NAME, e) TILE_int32(TABLE(NAME, n), e)
#define LEAF_int64(NAME, e) TILE_int64(TABLE(NAME, n), e)
#define LEAF_uint8(NAME, e) TILE_uint8(TABLE(NAME, n), e)
#define LEAF_uint16(NAME, e) TILE_uint16(TABLE(NAME, n), e)
#define LEAF_uint32(NAME, e) TILE_uint32(TABLE(NAME, n), e)
#define LEAF_half(NAME, e) TILE_half(TABLE(NAME, n), e)

// Voxels of leaves that are not plain elements. NanoVDB keeps the bits of a bool leaf right behind its mask, in the
// order of the voxels; PNanoVDB looks for them 16 bytes later and numbers them by x, so its own function cannot be
// used.
#define TILE_bit TILE_uint8
#define TILE_mask TILE_uint8
#define TILE_fp4 TILE_float
#define TILE_fp8 TILE_float
#define TILE_fp16 TILE_float
#define TILE_fpn TILE_float
#define LEAF_bit(NAME, e) pnanovdb_read_bit(buf, pnanovdb_address_offset(leaf.address, 80u + (n >> 3u)), n & 7u)
#define LEAF_mask(NAME, e) pnanovdb_leaf_get_value_mask(buf, leaf, n)
#define LEAF_fp4(NAME, e) pnanovdb_leaf_fp4_read_float(buf, TABLE(NAME, 0u), PNANOVDB_REF(ijk))
#define LEAF_fp8(NAME, e) pnanovdb_leaf_fp8_read_float(buf, TABLE(NAME, 0u), PNANOVDB_REF(ijk))
#define LEAF_fp16(NAME, e) pnanovdb_leaf_fp16_read_float(buf, TABLE(NAME, 0u), PNANOVDB_REF(ijk))
#define LEAF_fpn(NAME, e) pnanovdb_leaf_fpn_read_float(buf, TABLE(NAME, 0u), PNANOVDB_REF(ijk))

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

// Copies voxels along z of a float grid, all of them in one leaf or tile, whose node is that of node_of for the first.
static constexpr auto copy_float_run = [](unsigned long long volume, unsigned long long node, int i, int j, int k,
                                          int count, wp::array_t<float>& out_values, long long to) {
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_address_t at = {node & ~1ull};
    const pnanovdb_leaf_handle_t leaf = {at};
    const pnanovdb_coord_t ijk = {i, j, k};
    float* target = out_values.data + to;
    if ((node & 1u) == 0u) {
        const float value = pnanovdb_read_float(buf, at);
        for (int n = 0; n < count; ++n) target[n] = value;
        return;
    }
    const unsigned first_voxel = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk));
    for (int n = 0; n < count; ++n) {
        target[n] = pnanovdb_read_float(
            buf, pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_FLOAT, buf, leaf, first_voxel + (unsigned)n));
    }
};

// The value of a voxel of an int64 grid, whose node is that of node_of.
static constexpr auto read_int64 = [](unsigned long long volume, unsigned long long node, int i, int j,
                                      int k) -> long long {
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_address_t at = {node & ~1ull};
    const pnanovdb_leaf_handle_t leaf = {at};
    const pnanovdb_coord_t ijk = {i, j, k};
    const unsigned n = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk));
    if ((node & 1u) == 0u) return pnanovdb_read_int64(buf, at);
    return pnanovdb_read_int64(buf, pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_INT64, buf, leaf, n));
};
