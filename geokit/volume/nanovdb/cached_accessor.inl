// Finds the nodes of a NanoVDB grid and reads its voxels, for walks that keep the nodes they are in.
//
// Warp's own functions look up one voxel at a time, from the root, by its value type. Here coordinates are relative
// to an anchor voxel near the middle of what the grid holds, the first of a leaf: neither the grid's place in index
// space nor its transform's translation costs digits.
#pragma once
#include "volume/nanovdb/read_voxel.inl"

typedef unsigned long long address;
struct Nodes {
    unsigned long long volume;
    const unsigned char* grid;
    pnanovdb_grid_type_t type;
    // The anchor voxel: multiples of 8.
    int anchor[3];
    // The nodes around the last voxel that was looked for, 0 for none, and a voxel in each.
    address root, upper, lower;
    int in_upper[3], in_lower[3];
};
// Voxels have the type of the background. A grid of any type has one component.
struct FloatGrid : Nodes {
    float background;
};
struct AnyGrid : Nodes {
    double background;
};

// Compilers know that of a float grid.
static constexpr auto type_of = [](const auto& in) -> pnanovdb_grid_type_t {
    if constexpr (sizeof(in.background) == sizeof(float)) return PNANOVDB_GRID_TYPE_FLOAT;
    else return in.type;
};

static constexpr auto word = [](const auto& in, address at) -> address { return *(const address*)(in.grid + at); };

// Makes `lower` the node around a voxel and returns 0, or the address of the value of its tile or of the background;
// `size` is the edge of the block with that answer. The coordinates are not relative to the anchor.
static constexpr auto descend = [](auto& in, int i, int j, int k, int& size) -> address {
    const pnanovdb_grid_type_t type = type_of(in);
    size = 8;
    if (in.lower != 0 && !(((i ^ in.in_lower[0]) | (j ^ in.in_lower[1]) | (k ^ in.in_lower[2])) & ~127)) return 0;
    if (in.upper == 0 || (((i ^ in.in_upper[0]) | (j ^ in.in_upper[1]) | (k ^ in.in_upper[2])) & ~4095)) {
        const address key =
            (address)((unsigned)k >> 12) | (address)((unsigned)j >> 12) << 21 | (address)((unsigned)i >> 12) << 42;
        const unsigned count = *(const unsigned*)(in.grid + in.root + PNANOVDB_ROOT_OFF_TABLE_SIZE);
        const address stride = PNANOVDB_GRID_TYPE_GET(type, root_tile_size);
        address entry = in.root + PNANOVDB_GRID_TYPE_GET(type, root_size);
        unsigned n = 0;
        while (n < count && word(in, entry) != key) {
            entry += stride;
            ++n;
        }
        size = 4096;
        if (n == count) return in.root + PNANOVDB_GRID_TYPE_GET(type, root_off_background);
        const address child = word(in, entry + PNANOVDB_ROOT_TILE_OFF_CHILD);
        if (child == 0) return entry + PNANOVDB_GRID_TYPE_GET(type, root_tile_off_value);
        in.upper = in.root + child;
        in.in_upper[0] = i;
        in.in_upper[1] = j;
        in.in_upper[2] = k;
    }
    const unsigned slot = (i >> 7 & 31) << 10 | (j >> 7 & 31) << 5 | (k >> 7 & 31);
    const address at =
        in.upper + PNANOVDB_GRID_TYPE_GET(type, upper_off_table) + slot * PNANOVDB_GRID_TYPE_GET(type, table_stride);
    size = 128;
    if (!(in.grid[in.upper + PNANOVDB_UPPER_OFF_CHILD_MASK + (slot >> 3)] >> (slot & 7) & 1)) return at;
    size = 8;
    in.lower = in.upper + word(in, at);
    in.in_lower[0] = i;
    in.in_lower[1] = j;
    in.in_lower[2] = k;
    return 0;
};

// The leaf of a voxel in the lower node, marked by its lowest bit, or the address of the value of its tile.
static constexpr auto leaf_or_tile = [](const auto& in, int i, int j, int k) -> address {
    const unsigned slot = (i >> 3 & 15) << 8 | (j >> 3 & 15) << 4 | (k >> 3 & 15);
    const address at = in.lower + PNANOVDB_GRID_TYPE_GET(type_of(in), lower_off_table)
                       + slot * PNANOVDB_GRID_TYPE_GET(type_of(in), table_stride);
    if (!(in.grid[in.lower + PNANOVDB_LOWER_OFF_CHILD_MASK + (slot >> 3)] >> (slot & 7) & 1)) return at;
    return (in.lower + word(in, at)) | 1;
};

// The node of a voxel: the address of a leaf, marked by its lowest bit, or of a value; and the edge of the block with
// that value.
static constexpr auto find = [](auto& in, int x, int y, int z, int& size) -> address {
    const int i = (int)((unsigned)x + (unsigned)in.anchor[0]), j = (int)((unsigned)y + (unsigned)in.anchor[1]),
              k = (int)((unsigned)z + (unsigned)in.anchor[2]);
    const address tile = descend(in, i, j, k, size);
    return tile != 0 ? tile : leaf_or_tile(in, i, j, k);
};

// Voxels of float grids stand in their leaf as they are.
static constexpr auto voxel = [](const auto& in, address node, int x, int y, int z) -> decltype(in.background) {
    if constexpr (sizeof(in.background) == sizeof(float)) {
        const address at = node & 1 ? (node & ~1ull) + PNANOVDB_GRID_TYPE_GET(type_of(in), leaf_off_table)
                                          + 4 * ((x & 7) << 6 | (y & 7) << 3 | (z & 7))
                                    : node;
        return *(const float*)(in.grid + at);
    } else {
        const int i = (int)((unsigned)x + (unsigned)in.anchor[0]), j = (int)((unsigned)y + (unsigned)in.anchor[1]),
                  k = (int)((unsigned)z + (unsigned)in.anchor[2]);
        return read_voxel(in.volume, in.type, node, i, j, k, 0.0);
    }
};

// Reads the eight voxels of a cell, k fastest, if it lies in one leaf of a float grid; else returns false. (x, y, z) is
// its lowest voxel in the leaf.
static constexpr auto read_leaf_cell = [](const auto& in, address node, int x, int y, int z, auto* c) -> bool {
    if constexpr (sizeof(in.background) == sizeof(float))
        if ((node & 1) && x < 7 && y < 7 && z < 7) {
            const address at = (node & ~1ull) + PNANOVDB_GRID_TYPE_GET(type_of(in), leaf_off_table);
            const float* v = (const float*)(in.grid + at) + (x << 6 | y << 3 | z);
            c[0] = v[0];
            c[1] = v[1];
            c[2] = v[8];
            c[3] = v[9];
            c[4] = v[64];
            c[5] = v[65];
            c[6] = v[72];
            c[7] = v[73];
            return true;
        }
    return false;
};

static constexpr auto grid_of = [](auto number) {
    if constexpr (sizeof(number) == sizeof(float)) return FloatGrid();
    else return AnyGrid();
};
// A grid of floats where `number` is one, else of any type.
static constexpr auto opened = [](unsigned long long volume, const auto& anchor, auto number) {
    auto in = grid_of(number);
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    in.volume = volume;
    in.grid = (const unsigned char*)buf.data;
    in.type = (pnanovdb_grid_type_t)wp::volume::get_grid_type(buf);
    in.root = wp::volume::get_root(buf).address.byte_offset;
    for (int axis = 0; axis < 3; ++axis) in.anchor[axis] = anchor[axis];
    in.background = voxel(in, in.root + PNANOVDB_GRID_TYPE_GET(type_of(in), root_off_background), 0, 0, 0);
    return in;
};
