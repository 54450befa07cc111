// Flood fill over the bit mask of a leaf: word x, bit 8 y + z.
//
// Expects nothing. Defines flood(links, open, seed, region), which sets the bits of region (8 words) that a flood from
// voxel `seed` reaches through links (24 words) among the voxels of `open`.
auto flood = [](const unsigned long long* links, const unsigned long long* open, int seed, unsigned long long* region) {
    for (int x = 0; x < 8; ++x) region[x] = 0;
    region[seed >> 6] = 1ull << (seed & 63);
    auto grow = [&](int x, unsigned long long m) {
        const unsigned long long z = links[3 * x], y = links[3 * x + 1];
        unsigned long long before = 0;
        m &= open[x];
        while (m != before) {
            before = m;
            m |= ((m & z) << 1) | ((m >> 1) & z);
            m |= ((m & y) << 8) | ((m >> 8) & y);
            m &= open[x];
        }
        return m;
    };
    bool more = true;
    while (more) {
        more = false;
        for (int x = 0; x < 8; ++x) {
            unsigned long long m = region[x];
            if (x) m |= region[x - 1] & links[3 * x - 1];
            m = m ? grow(x, m) : m;
            more = more || m != region[x];
            region[x] = m;
        }
        for (int x = 6; x >= 0; --x) {
            unsigned long long m = region[x] | (region[x + 1] & links[3 * x + 2]);
            m = m ? grow(x, m) : m;
            more = more || m != region[x];
            region[x] = m;
        }
    }
};
