// Tiles of 8^3 voxels of a dense array: see dense_tiles_kernels.
#include "core/simd.inl"

static constexpr auto magnitude = [](const v8& values) -> v8 { return __builtin_elementwise_abs(values); };

// The eight values of a row from voxel z on, as float32; the background outside the array.
static constexpr auto row_of = [](const auto& dense, float background, int i, int j, int z) {
    typedef decltype(*dense.data + *dense.data) number;
    typedef number eight __attribute__((ext_vector_type(8), aligned(sizeof(number))));
    v8 values = background;
    if (i < 0 || j < 0 || i >= dense.shape[0] || j >= dense.shape[1]) return values;
    const number* row =
        (const number*)((const char*)dense.data + i * (size_t)dense.strides[0] + j * (size_t)dense.strides[1]);
    if (z >= 0 && z + 8 <= dense.shape[2]) return __builtin_convertvector(*(const eight*)(row + z), v8);
    for (int k = z < 0 ? -z : 0; k < 8 && z + k < dense.shape[2]; ++k) values[k] = (float)row[z + k];
    return values;
};

// Lanes of the values that differ from the background by more than the tolerance; in a level set, from both its signs.
static constexpr auto is_active = [](const v8& values, float background, double tolerance, int level_set) {
    const d8 level = __builtin_convertvector(level_set ? magnitude(values) : values, d8);
    return __builtin_elementwise_abs(level - (double)background) > tolerance;
};

// The state of a tile, from its first voxel in the array: BAD if float32 cannot hold a value, LEAF if it has an active
// voxel or both signs, INSIDE if all its voxels are negative, else OUTSIDE.
static constexpr auto tile_state = [](const auto& dense, int x, int y, int z, float background, double tolerance,
                                      int level_set) -> int {
    unsigned active = 0, some = 0, all = 255, good = 255;
    for (int n = 0; n < 64; ++n) {
        const v8 values = row_of(dense, background, x + (n >> 3), y + (n & 7), z);
        const unsigned negative = mask_of(values < 0.f);
        active |= mask_of(is_active(values, background, tolerance, level_set));
        some |= negative;
        all &= negative;
        // No comparison with NaN holds.
        good &= mask_of(magnitude(values) <= 3.402823466e38f);
    }
    if (good != 255) return BAD;
    if (active) return LEAF;
    if (!level_set || !some) return OUTSIDE;
    // A block with both signs cannot be a tile, so it is a leaf without active voxels.
    return all == 255 ? INSIDE : LEAF;
};
static constexpr auto write_state = [](int tile, const auto& dense, const wp::vec3i& shift, int count_y, int count_z,
                                       float background, double tolerance, int level_set, auto& out_state) {
    const int x = 8 * (tile / (count_z * count_y)) - shift[0], y = 8 * (tile / count_z % count_y) - shift[1],
              z = 8 * (tile % count_z) - shift[2];
    out_state.data[tile] = (unsigned char)tile_state(dense, x, y, z, background, tolerance, level_set);
};

// Writes a tile's values and the mask of its active voxels; inactive voxels take the background's value, in a level
// set with their own sign.
static constexpr auto fill_tile = [](int t, const auto& dense, const wp::vec3i& shift, const wp::array_t<int>& tiles,
                                     const wp::array_t<int>& rows, float background, double tolerance, int level_set,
                                     wp::array_t<float>& out_values, wp::array_t<uint8_t>& out_masks) {
    const int row = rows.data[t], x = 8 * tiles.data[3 * t] - shift[0], y = 8 * tiles.data[3 * t + 1] - shift[1],
              z = 8 * tiles.data[3 * t + 2] - shift[2];
    v8* to = (v8*)((char*)out_values.data + row * (size_t)out_values.strides[0]);
    unsigned char* mask = out_masks.data + row * (size_t)out_masks.strides[0];
    for (int n = 0; n < 64; ++n) {
        const v8 values = row_of(dense, background, x + (n >> 3), y + (n & 7), z);
        const i8 active = __builtin_convertvector(is_active(values, background, tolerance, level_set), i8),
                 inside = (values < 0.f) & (level_set ? -1 : 0);
        to[n] = active ? values : inside ? (v8)-background : (v8)background;
        mask[n] = (unsigned char)mask_of(active);
    }
};
