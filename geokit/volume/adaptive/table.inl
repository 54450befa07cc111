// Leaves of an adaptive field and their active voxels: see table_kernels.
#include "volume/sampling/leaf_table.inl"

// Whether the voxel (i, j, k) lies in a leaf of a table's grid and is active there.
static constexpr auto is_active = [](const LeafTable& table, int i, int j, int k) -> bool {
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
static constexpr auto leaf_corner = [](const LeafTable& table, int entry) -> wp::vec3i {
    // The first active voxel of the leaf, or of one without any its first: with its low bits cleared the corner.
    const int* const box = (const int*)(table.grid + (unsigned long long)entry * 32ull);
    return wp::vec3i(box[0] & ~7, box[1] & ~7, box[2] & ~7);
};
