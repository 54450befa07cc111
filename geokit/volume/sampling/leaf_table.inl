// Look-ups in a LeafTable, by voxels relative to its box: see leaf_table_kernels.
#pragma once

// The members of a table that look-ups read.
struct Entries {
    const int *top, *slots;
    int size_y, size_z;
};
static constexpr auto entries_of = [](const auto& table) -> Entries {
    return {table.top.data, table.slots.data, table.size[1], table.size[2]};
};
static constexpr auto upper_of = [](const Entries& entries, int x, int y, int z) -> int {
    return ((x >> 7) * entries.size_y + (y >> 7)) * entries.size_z + (z >> 7);
};
static constexpr auto slot_of = [](int x, int y, int z) -> int {
    return ((x >> 3) & 15) << 8 | ((y >> 3) & 15) << 4 | ((z >> 3) & 15);
};
// The entry of a voxel: a leaf, or the complement of the place of a tile's value, which is negative.
static constexpr auto entry_of = [](const Entries& entries, int x, int y, int z) -> int {
    const int start = entries.top[upper_of(entries, x, y, z)];
    return start < 0 ? start : entries.slots[start + slot_of(x, y, z)];
};
// The place of a voxel's value in the grid, in floats.
static constexpr auto place_of = [](int entry, int x, int y, int z) -> long long {
    return entry < 0 ? (long long)~entry : (long long)entry * 8 + 24 + ((x & 7) << 6 | (y & 7) << 3 | (z & 7));
};

// The value of voxel (i, j, k) of a float grid; the voxel must lie in the box.
static constexpr auto table_voxel = [](const auto& table, int i, int j, int k) -> float {
    const int x = i - table.lower[0], y = j - table.lower[1], z = k - table.lower[2];
    return ((const float*)table.grid)[place_of(entry_of(entries_of(table), x, y, z), x, y, z)];
};

// Whether the voxel (i, j, k) lies in a leaf of a table's grid and is active there.
static constexpr auto holds_active = [](const auto& table, int i, int j, int k) -> bool {
    const int x = i - table.lower[0], y = j - table.lower[1], z = k - table.lower[2];
    if (x < 0 || y < 0 || z < 0) return false;
    if (x >= table.size[0] * 128 || y >= table.size[1] * 128 || z >= table.size[2] * 128) return false;
    const int entry = entry_of(entries_of(table), x, y, z);
    if (entry < 0) return false;
    typedef unsigned long long word;
    const word* const mask = (const word*)(table.grid + (word)entry * 32ull + 16ull);
    return (mask[x & 7] >> ((y & 7) << 3 | (z & 7))) & 1ull;
};

// First voxel of the leaf of an entry.
static constexpr auto leaf_corner = [](const auto& table, int entry) -> wp::vec3i {
    // The first active voxel of the leaf, or of one without any its first: with its low bits cleared the corner.
    const int* const box = (const int*)(table.grid + (unsigned long long)entry * 32ull);
    return wp::vec3i(box[0] & ~7, box[1] & ~7, box[2] & ~7);
};

// The tree level that holds the value of a voxel: 0 leaf, 1 lower node, 2 upper node, 3 and more the root.
static constexpr auto level_of = [](unsigned long long volume, int i, int j, int k) -> int {
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_coord_t ijk = {i, j, k};
    pnanovdb_readaccessor_t accessor;
    pnanovdb_readaccessor_init(PNANOVDB_REF(accessor), wp::volume::get_root(buf));
    unsigned level;
    pnanovdb_readaccessor_get_value_address_and_level((pnanovdb_grid_type_t)wp::volume::get_grid_type(buf), buf,
                                                      PNANOVDB_REF(accessor), PNANOVDB_REF(ijk), PNANOVDB_REF(level));
    return (int)level;
};
