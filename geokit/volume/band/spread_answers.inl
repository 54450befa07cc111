// Spreads the answers at the regions' voxels over their regions, then in rounds to voxels that only a diagonal
// neighbor decides.
//
// Expects flood_leaf.inl; leaf, rows, distance, all_links, seeds, answers, spacing, rounds, out_known, out_inside;
// REGIONS.
unsigned long long* known = (unsigned long long*)out_known.data + 8ll * leaf;
unsigned long long* inside = (unsigned long long*)out_inside.data + 8ll * leaf;
const unsigned long long* links = (const unsigned long long*)all_links.data + 24ll * leaf;
const float* d = distance.data + 512ll * rows.data[leaf];
unsigned long long open[8], region[8];
for (int x = 0; x < 8; ++x) open[x] = ~known[x];
for (int n = 0; n < REGIONS; ++n) {
    const int seed = seeds.data[(long long)REGIONS * leaf + n];
    if (seed < 0) continue;
    const bool within = answers.data[(long long)REGIONS * leaf + n];
    flood(links, open, seed, region);
    for (int x = 0; x < 8; ++x) {
        open[x] &= ~region[x];
        known[x] |= region[x];
        if (within) inside[x] |= region[x];
    }
}
// Diagonal neighbors are farther apart, and one of them lies nearly along the surface normal.
const float edge = spacing * 1.41421356f, corner = spacing * 1.73205081f;
for (int round = 0; round < rounds; ++round)
    for (int x = 0; x < 8; ++x)
        for (unsigned long long left = ~known[x]; left; left &= left - 1) {
            #if defined(__CUDA_ARCH__)
            const int b = __ffsll((long long)left) - 1;
            #else
            const int b = __builtin_ctzll(left);
            #endif
            const int y = b >> 3, z = b & 7;
            const float here = d[64 * x + b];
            bool found = false;
            for (int n = 0; n < 27 && !found; ++n) {
                const int dx = n / 9 - 1, dy = n / 3 % 3 - 1, dz = n % 3 - 1, steps = dx * dx + dy * dy + dz * dz;
                const int u = x + dx, v = y + dy, w = z + dz;
                if (steps < 1 || u < 0 || u > 7 || v < 0 || v > 7 || w < 0 || w > 7) continue;
                const int at = 8 * v + w;
                if (!(known[u] >> at & 1)) continue;
                const float apart = steps == 1 ? spacing : steps == 2 ? edge : corner;
                if (!(here + d[64 * u + at] > apart)) continue;
                known[x] |= 1ull << b;
                if (inside[u] >> at & 1) inside[x] |= 1ull << b;
                found = true;
            }
        }
