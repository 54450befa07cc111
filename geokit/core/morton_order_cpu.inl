// Morton order on a CPU: a counting sort by the high bits of keys, then sorted buckets. See morton_order_cpu_kernels.
#include "core/simd.inl"

// First step: the keys of a share of the points, and how many of them are in each bucket.
//
// Eight points are three vectors of eight numbers, and number e of vector v is always of one axis. Doubles go by fours:
// wider vectors lower the clock of some processors, for the search as well.
static constexpr auto count_share = [](int item, int share, const wp::array_t<wp::vec3d>& points,
                                       const wp::vec3d& lower, double inverse_extent, wp::array_t<unsigned>& out_key,
                                       wp::array_t<int>& out_counts) {
    const int begin = item * share, end = wp::min(begin + share, points.shape[0]);
    const double* rows = (const double*)points.data;
    unsigned* const keys = out_key.data;
    int* const counts = out_counts.data + item * BUCKETS;
    alignas(32) d4 origin[6];
    alignas(32) u8 shift[3];
    for (int e = 0; e < 24; ++e) {
        origin[e / 4][e % 4] = lower[e % 3];
        shift[e / 8][e % 8] = e % 3;
    }
    const d4 zero = 0.0, one = 1.0;
    // As morton_kernel has it. NaN is 0.
    auto keys_of = [&](const double* from, unsigned* to) {
        unsigned part[24];
        for (int v = 0; v < 3; ++v) {
            i4 half[2];
            for (int h = 0; h < 2; ++h) {
                d4 u = (*(const d4*)(from + 8 * v + 4 * h) - origin[2 * v + h]) * inverse_extent;
                u = u > zero ? u : zero;
                u = u < one ? u : one;
                half[h] = __builtin_convertvector(u * 1023.0, i4);
            }
            u8 x = __builtin_bit_cast(u8, __builtin_shufflevector(half[0], half[1], 0, 1, 2, 3, 4, 5, 6, 7));
            x = (x | (x << 16u)) & 0x030000FFu;
            x = (x | (x << 8u)) & 0x0300F00Fu;
            x = (x | (x << 4u)) & 0x030C30C3u;
            x = (x | (x << 2u)) & 0x09249249u;
            x <<= shift[v];
            __builtin_memcpy(part + 8 * v, &x, sizeof(x));
        }
        for (int j = 0; j < 8; ++j) to[j] = part[3 * j] | part[3 * j + 1] | part[3 * j + 2];
    };
    int i = begin;
    for (; i + 8 <= end; i += 8) {
        keys_of(rows + 3ll * i, keys + i);
        for (int j = 0; j < 8; ++j) ++counts[keys[i + j] >> LOW_BITS];
    }
    if (i < end) {
        double rest[24] = {};
        unsigned key[8];
        for (int k = 0; k < 3 * (end - i); ++k) rest[k] = rows[3ll * i + k];
        keys_of(rest, key);
        for (int j = 0; i < end; ++i, ++j) {
            keys[i] = key[j];
            ++counts[key[j] >> LOW_BITS];
        }
    }
};

// Last step: puts the low bits of each key of a share, and the number of its point, into its bucket. Moves the places on.
static constexpr auto place_share = [](int item, int share, const wp::array_t<unsigned>& keys,
                                       const wp::array_t<int>& places, wp::array_t<wp::uint64>& out_pairs) {
    const int begin = item * share, end = wp::min(begin + share, keys.shape[0]);
    int* const place = places.data + item * BUCKETS;
    for (int i = begin; i < end; ++i) {
        const unsigned key = keys.data[i];
        out_pairs.data[place[key >> LOW_BITS]++] = (wp::uint64)(key & ((1u << LOW_BITS) - 1u)) << 32 | (unsigned)i;
    }
};

// Sorts the points of a bucket by the low bits of their keys, digit by digit from the lowest on.
static constexpr auto sort_bucket = [](int bucket, const wp::array_t<int>& start, const wp::array_t<wp::uint64>& pairs,
                                       const wp::array_t<wp::uint64>& spare, wp::array_t<int>& out_order) {
    const int begin = start.data[bucket], n = start.data[bucket + 1] - begin;
    if (n == 0) return;
    wp::uint64 *from = pairs.data + begin, *to = spare.data + begin;
    int* const order = out_order.data + begin;
    if (n < FEW) {
        for (int i = 1; i < n; ++i) {
            const wp::uint64 pair = from[i];
            int at = i;
            for (; at > 0 && from[at - 1] > pair; --at) from[at] = from[at - 1];
            from[at] = pair;
        }
        for (int i = 0; i < n; ++i) order[i] = (int)(unsigned)from[i];
        return;
    }
    const int width = n < MANY ? LOW_BITS / 3 : LOW_BITS / 2, passes = LOW_BITS / width;
    const unsigned mask = (1u << width) - 1u;
    int counts[3][1 << LOW_BITS / 2];
    for (int pass = 0; pass < passes; ++pass)
        for (unsigned digit = 0; digit <= mask; ++digit) counts[pass][digit] = 0;
    for (int i = 0; i < n; ++i)
        for (int pass = 0; pass < passes; ++pass) ++counts[pass][(unsigned)(from[i] >> 32) >> width * pass & mask];
    for (int pass = 0; pass < passes; ++pass) {
        int* const place = counts[pass];
        for (unsigned digit = 0, at = 0; digit <= mask; ++digit) {
            const int more = place[digit];
            place[digit] = at;
            at += more;
        }
        if (pass + 1 == passes) {
            for (int i = 0; i < n; ++i)
                order[place[(unsigned)(from[i] >> 32) >> width * pass & mask]++] = (int)(unsigned)from[i];
            return;
        }
        for (int i = 0; i < n; ++i) to[place[(unsigned)(from[i] >> 32) >> width * pass & mask]++] = from[i];
        wp::uint64* const other = from;
        from = to;
        to = other;
    }
};
