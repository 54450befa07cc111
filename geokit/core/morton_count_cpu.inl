// Morton keys of a share of the points, and how many of them are in each bucket: the first step of a counting sort.
//
// Expects core/simd.inl, begin, share, points, lower, inverse_extent, out_key, out_counts, BUCKETS, LOW_BITS.
//
// Eight points are three vectors of eight numbers, and number e of vector v is always of one axis. Doubles go by fours:
// wider vectors lower the clock of some processors, for the search as well.

#if !defined(__CUDA_ARCH__)
const int count = points.shape[0], end = begin + share < count ? begin + share : count;
const double* rows = (const double*)points.data;
unsigned* const keys = out_key.data;
int* const counts = out_counts.data + begin / share * BUCKETS;
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
#endif
