// Descends for the queries of a group whose cell of level 0 is refined, one by one, before the voxels of all are
// prefetched.
//
// Expects the names of trilinear_cells.inl for a group, and levels, an AdaptiveLevels. Changes at_x, at_y, at_z, u,
// v, w, first and last of these queries. Defines voxels, an address for each query, and level_of, its level.
const unsigned* const words = levels.finer.data + levels.first_word.data[0];
const int coarse_first = levels.first_entry.data[0];
const bool alone = levels.tables.shape[0] == 1;
int level_of[G];
const float* voxels[G];
unsigned long long handed_on = 0;
for (int q = 0; q < G; ++q) {
    level_of[q] = 0;
    voxels[q] = (const float*)coarsest.grid;
    const bool leaf = (first[q] >= 0) & !alone;
    const int y = at_y[q], word = (at_x[q] & 7) << 1 | (y & 7) >> 2, bit = (y & 3) << 3 | (at_z[q] & 7);
    const unsigned some = words[leaf ? 16ll * ((first[q] - coarse_first) / 67) + word : 0];
    handed_on |= (unsigned long long)(leaf & ((some >> bit) & 1u)) << q;
}
for (; handed_on; handed_on &= handed_on - 1) {
    const int n = __builtin_ctzll(handed_on);
    int i = at_x[n] + lower_x, j = at_y[n] + lower_y, k = at_z[n] + lower_z;
    double x = u[n], y = v[n], z = w[n];
#include "volume/adaptive/descent.inl"
    const auto& table = LEVEL_TABLE(level);
    TREE_OF(table)
    at_x[n] = a;
    at_y[n] = b;
    at_z[n] = c;
    u[n] = x;
    v[n] = y;
    w[n] = z;
    FIND_ENTRY(a + 1, b + 1, c + 1)
    first[n] = e000;
    last[n] = entry;
    voxels[n] = (const float*)table.grid;
    level_of[n] = level;
}
