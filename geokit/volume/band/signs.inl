// Links between the voxels of leaves, and regions of linked voxels: see signs_kernels.
#include "core/simd.inl"

// Links of a plane of 64 voxels to the next ones along z, along y and in the next plane. The bit of a link is set if
// the distances of both voxels add up to more than their spacing, so that the surface cannot lie between them.
static constexpr auto write_links = [](int item, const wp::array_t<int>& rows, const wp::array_t<float>& distance,
                                       float spacing, wp::array_t<uint64_t>& out_links) {
    const int leaf = item >> 3, x = item & 7;
    const float* d = distance.data + 512ll * rows.data[leaf] + 64 * x;
    unsigned long long z = 0, y = 0, next = 0;
    #if defined(__CUDA_ARCH__)
    for (int b = 0; b < 64; ++b) {
        const float here = d[b];
        if ((b & 7) < 7 && here + d[b + 1] > spacing) z |= 1ull << b;
        if (b < 56 && here + d[b + 8] > spacing) y |= 1ull << b;
        if (x < 7 && here + d[b + 64] > spacing) next |= 1ull << b;
    }
    #else
    for (int r = 0; r < 8; ++r) {
        const v8 here = *(const v8*)(d + 8 * r);
        const v8 shifted = __builtin_shufflevector(here, here, 1, 2, 3, 4, 5, 6, 7, 7);
        z |= ((unsigned long long)mask_of(here + shifted > spacing) & 0x7f) << 8 * r;
        if (r < 7) y |= (unsigned long long)mask_of(here + *(const v8*)(d + 8 * r + 8) > spacing) << 8 * r;
        if (x < 7) next |= (unsigned long long)mask_of(here + *(const v8*)(d + 8 * r + 64) > spacing) << 8 * r;
    }
    #endif
    unsigned long long* out = (unsigned long long*)out_links.data + 24ll * leaf + 3 * x;
    out[0] = z;
    out[1] = y;
    out[2] = next;
};

// Sets the bits of region (8 words) that a flood from voxel `seed` reaches through links (24 words) among the voxels of
// `open`: word x, bit 8 y + z.
static constexpr auto flood = [](const unsigned long long* links, const unsigned long long* open, int seed,
                                 unsigned long long* region) {
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

// Finds the farthest voxel of each region of unknown voxels in a leaf; farthest voxels come first.
static constexpr auto find_regions = [](int leaf, const wp::array_t<int>& rows, const wp::array_t<float>& distance,
                                        const wp::array_t<uint64_t>& all_links, const wp::array_t<uint64_t>& known_bits,
                                        float least, float reach, wp::array_t<int>& out_seed) {
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
};

// Spreads the answers at the regions' voxels over their regions, then in rounds to voxels that only a diagonal
// neighbor decides.
static constexpr auto spread_answers = [](int leaf, const wp::array_t<int>& rows, const wp::array_t<float>& distance,
                                          const wp::array_t<uint64_t>& all_links, const wp::array_t<int>& seeds,
                                          const wp::array_t<bool>& answers, float spacing, int rounds,
                                          wp::array_t<uint64_t>& out_known, wp::array_t<uint64_t>& out_inside) {
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
};
