// Finds the nodes of a NanoVDB grid and reads its voxels, for walks that keep the nodes they are in.
//
// Warp's own functions look up one voxel at a time, from the root, by its value type. Here coordinates are relative
// to an anchor voxel near the middle of what the grid holds, the first of a leaf: neither the grid's place in index
// space nor its transform's translation costs digits.
//
// Expects volume; anchor (int, multiples of 8); the macro FLOAT_GRID: 1 for grids of floats, 0 for any type of one
// component. Defines the types address and real (of voxels), grid_type, root, background, ignored; find, which gives
// the node of a voxel: the address of a leaf, marked by its lowest bit, or of a value, and the edge of the block with
// that value; descend and leaf_or_tile, its two steps, which take coordinates that are not relative; voxel, which
// reads one.
const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
const unsigned char* grid = (const unsigned char*)buf.data;
typedef unsigned long long address;
const pnanovdb_grid_type_t grid_type = (pnanovdb_grid_type_t)(
#if FLOAT_GRID
    PNANOVDB_GRID_TYPE_FLOAT
#else
    wp::volume::get_grid_type(buf)
#endif
);
const address root = wp::volume::get_root(buf).address.byte_offset;
auto word = [&](address at) { return *(const address*)(grid + at); };
address upper_node = 0, lower_node = 0;
int in_upper[3] = {0, 0, 0}, in_lower[3] = {0, 0, 0};
// Makes `lower_node` the one around a voxel and returns 0, or the address of the value of its tile or of the
// background; `size` is the edge of the block with that answer.
auto descend = [&](int i, int j, int k, int& size) -> address {
    size = 8;
    if (lower_node != 0 && !(((i ^ in_lower[0]) | (j ^ in_lower[1]) | (k ^ in_lower[2])) & ~127)) return 0;
    if (upper_node == 0 || (((i ^ in_upper[0]) | (j ^ in_upper[1]) | (k ^ in_upper[2])) & ~4095)) {
        const address key =
            (address)((unsigned)k >> 12) | (address)((unsigned)j >> 12) << 21 | (address)((unsigned)i >> 12) << 42;
        const unsigned count = *(const unsigned*)(grid + root + PNANOVDB_ROOT_OFF_TABLE_SIZE);
        const address stride = PNANOVDB_GRID_TYPE_GET(grid_type, root_tile_size);
        address entry = root + PNANOVDB_GRID_TYPE_GET(grid_type, root_size);
        unsigned n = 0;
        while (n < count && word(entry) != key) {
            entry += stride;
            ++n;
        }
        size = 4096;
        if (n == count) return root + PNANOVDB_GRID_TYPE_GET(grid_type, root_off_background);
        const address child = word(entry + PNANOVDB_ROOT_TILE_OFF_CHILD);
        if (child == 0) return entry + PNANOVDB_GRID_TYPE_GET(grid_type, root_tile_off_value);
        upper_node = root + child;
        in_upper[0] = i;
        in_upper[1] = j;
        in_upper[2] = k;
    }
    const unsigned slot = (i >> 7 & 31) << 10 | (j >> 7 & 31) << 5 | (k >> 7 & 31);
    const address at = upper_node + PNANOVDB_GRID_TYPE_GET(grid_type, upper_off_table)
                       + slot * PNANOVDB_GRID_TYPE_GET(grid_type, table_stride);
    size = 128;
    if (!(grid[upper_node + PNANOVDB_UPPER_OFF_CHILD_MASK + (slot >> 3)] >> (slot & 7) & 1)) return at;
    size = 8;
    lower_node = upper_node + word(at);
    in_lower[0] = i;
    in_lower[1] = j;
    in_lower[2] = k;
    return 0;
};
// The leaf in a slot of the lower node, marked by its lowest bit, or the address of the value of its tile.
auto leaf_or_tile = [&](unsigned slot) -> address {
    const address at = lower_node + PNANOVDB_GRID_TYPE_GET(grid_type, lower_off_table)
                       + slot * PNANOVDB_GRID_TYPE_GET(grid_type, table_stride);
    if (!(grid[lower_node + PNANOVDB_LOWER_OFF_CHILD_MASK + (slot >> 3)] >> (slot & 7) & 1)) return at;
    return (lower_node + word(at)) | 1;
};
auto find = [&](int x, int y, int z, int& size) -> address {
    const int i = (int)((unsigned)x + (unsigned)anchor[0]), j = (int)((unsigned)y + (unsigned)anchor[1]),
              k = (int)((unsigned)z + (unsigned)anchor[2]);
    const address tile = descend(i, j, k, size);
    return tile != 0 ? tile : leaf_or_tile((i >> 3 & 15) << 8 | (j >> 3 & 15) << 4 | (k >> 3 & 15));
};
#if FLOAT_GRID
// Voxels of float grids stand in their leaf as they are.
typedef float real;
auto voxel = [&](address node, int x, int y, int z) -> real {
    const address at = node & 1 ? (node & ~1ull) + PNANOVDB_GRID_TYPE_GET(grid_type, leaf_off_table)
                                      + 4 * ((x & 7) << 6 | (y & 7) << 3 | (z & 7))
                                : node;
    return *(const float*)(grid + at);
};
#else
typedef double real;
auto voxel = [&](address node, int x, int y, int z) -> real {
    const int i = (int)((unsigned)x + (unsigned)anchor[0]), j = (int)((unsigned)y + (unsigned)anchor[1]),
              k = (int)((unsigned)z + (unsigned)anchor[2]);
#define COMPONENTS 1
#include "volume/nanovdb/read_voxel.inl"
#undef COMPONENTS
};
#endif
int ignored;
const real background = voxel(root + PNANOVDB_GRID_TYPE_GET(grid_type, root_off_background), 0, 0, 0);
