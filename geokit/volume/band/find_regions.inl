// Finds the farthest voxel of each region of unknown voxels in a leaf; farthest voxels come first.
//
// Expects flood_leaf.inl; leaf, rows, distance, all_links, known_bits, least, reach, out_seed; REGIONS.
const unsigned long long* known = (const unsigned long long*)known_bits.data + 8ll * leaf;
const unsigned long long* links = (const unsigned long long*)all_links.data + 24ll * leaf;
const float* d = distance.data + 512ll * rows.data[leaf];
unsigned long long open[8], region[8];
for (int x = 0; x < 8; ++x) open[x] = ~known[x];
for (int n = 0; n < REGIONS; ++n) {
    int farthest = -1;
    float largest = least;
    for (int x = 0; x < 8; ++x)
        for (int b = 0; open[x] && b < 64; ++b)
            if (open[x] >> b & 1) {
                // A search from a voxel with a cut-off distance is wide, so it is chosen only if there is no other.
                const float here = d[64 * x + b] < reach ? d[64 * x + b] : least;
                if (!(here >= largest) || (farthest >= 0 && here == largest)) continue;
                largest = here;
                farthest = 64 * x + b;
            }
    out_seed.data[(long long)REGIONS * leaf + n] = farthest;
    if (farthest < 0) continue;
    flood(links, open, farthest, region);
    for (int x = 0; x < 8; ++x) open[x] &= ~region[x];
}
