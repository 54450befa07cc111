"""Morton order on a CPU, by all threads: the highest bits of a key say where its point goes, the rest is sorted there.

As stable as one sort of all keys, so that the order is the same for any number of threads.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Bits of a key that are told apart at once: there are as many buckets as they have values.
TOP_BITS = 12
BUCKETS = 1 << TOP_BITS
LOW_BITS = 30 - TOP_BITS
# Points of a bucket from which on nine bits are sorted at a time, six below, and one by one below the other.
MANY, FEW = 1024, 24

# Eight points are three vectors of eight numbers, and number e of vector v is always of one axis. Doubles go by fours:
# wider vectors lower the clock of some processors, for the search as well.
TALLY = f"""
#if !defined(__CUDA_ARCH__)
    typedef double d4 __attribute__((ext_vector_type(4), aligned(8)));
    typedef int i4 __attribute__((ext_vector_type(4)));
    typedef unsigned u8 __attribute__((ext_vector_type(8)));
    const int count = points.shape[0], end = begin + share < count ? begin + share : count;
    const double* rows = (const double*)points.data;
    unsigned* const keys = out_key.data;
    int* const tally = out_tally.data + begin / share * {BUCKETS};
    d4 origin[6];
    u8 shift[3];
    for (int e = 0; e < 24; ++e) {{
        origin[e / 4][e % 4] = lower[e % 3];
        shift[e / 8][e % 8] = e % 3;
    }}
    const d4 zero = 0.0, one = 1.0;
    // As morton_kernel has it. NaN is 0.
    auto keys_of = [&](const double* from, unsigned* to) {{
        unsigned part[24];
        for (int v = 0; v < 3; ++v) {{
            i4 half[2];
            for (int h = 0; h < 2; ++h) {{
                d4 u = (*(const d4*)(from + 8 * v + 4 * h) - origin[2 * v + h]) * inverse_extent;
                u = u > zero ? u : zero;
                u = u < one ? u : one;
                half[h] = __builtin_convertvector(u * 1023.0, i4);
            }}
            u8 x = __builtin_bit_cast(u8, __builtin_shufflevector(half[0], half[1], 0, 1, 2, 3, 4, 5, 6, 7));
            x = (x | (x << 16u)) & 0x030000FFu;
            x = (x | (x << 8u)) & 0x0300F00Fu;
            x = (x | (x << 4u)) & 0x030C30C3u;
            x = (x | (x << 2u)) & 0x09249249u;
            x <<= shift[v];
            __builtin_memcpy(part + 8 * v, &x, sizeof(x));
        }}
        for (int j = 0; j < 8; ++j) to[j] = part[3 * j] | part[3 * j + 1] | part[3 * j + 2];
    }};
    int i = begin;
    for (; i + 8 <= end; i += 8) {{
        keys_of(rows + 3ll * i, keys + i);
        for (int j = 0; j < 8; ++j) ++tally[keys[i + j] >> {LOW_BITS}];
    }}
    if (i < end) {{
        double rest[24] = {{}};
        unsigned key[8];
        for (int k = 0; k < 3 * (end - i); ++k) rest[k] = rows[3ll * i + k];
        keys_of(rest, key);
        for (int j = 0; i < end; ++i, ++j) {{
            keys[i] = key[j];
            ++tally[key[j] >> {LOW_BITS}];
        }}
    }}
#endif
"""

PLACE = f"""
    const int count = keys.shape[0], end = begin + share < count ? begin + share : count;
    int* const place = tally.data + begin / share * {BUCKETS};
    for (int i = begin; i < end; ++i) {{
        const unsigned key = keys.data[i];
        out_pairs.data[place[key >> {LOW_BITS}]++] = (wp::uint64)(key & {(1 << LOW_BITS) - 1}u) << 32 | (unsigned)i;
    }}
"""

SORT = f"""
    const int begin = start.data[bucket], n = start.data[bucket + 1] - begin;
    if (n == 0) return;
    wp::uint64 *from = pairs.data + begin, *to = spare.data + begin;
    int* const order = out_order.data + begin;
    if (n < {FEW}) {{
        for (int i = 1; i < n; ++i) {{
            const wp::uint64 pair = from[i];
            int at = i;
            for (; at > 0 && from[at - 1] > pair; --at) from[at] = from[at - 1];
            from[at] = pair;
        }}
        for (int i = 0; i < n; ++i) order[i] = (int)(unsigned)from[i];
        return;
    }}
    const int width = n < {MANY} ? {LOW_BITS // 3} : {LOW_BITS // 2}, passes = {LOW_BITS} / width;
    const unsigned mask = (1u << width) - 1u;
    int tally[3][{1 << (LOW_BITS // 2)}];
    for (int pass = 0; pass < passes; ++pass)
        for (unsigned digit = 0; digit <= mask; ++digit) tally[pass][digit] = 0;
    for (int i = 0; i < n; ++i)
        for (int pass = 0; pass < passes; ++pass) ++tally[pass][(unsigned)(from[i] >> 32) >> width * pass & mask];
    for (int pass = 0; pass < passes; ++pass) {{
        int* const place = tally[pass];
        for (unsigned digit = 0, at = 0; digit <= mask; ++digit) {{
            const int more = place[digit];
            place[digit] = at;
            at += more;
        }}
        if (pass + 1 == passes) {{
            for (int i = 0; i < n; ++i)
                order[place[(unsigned)(from[i] >> 32) >> width * pass & mask]++] = (int)(unsigned)from[i];
            return;
        }}
        for (int i = 0; i < n; ++i) to[place[(unsigned)(from[i] >> 32) >> width * pass & mask]++] = from[i];
        wp::uint64* const other = from;
        from = to;
        to = other;
    }}
"""


@wp.func_native(TALLY)
def tally_share(
    begin: int,
    share: int,
    points: wp.array(dtype=wp.vec3d),
    lower: wp.vec3d,
    inverse_extent: wp.float64,
    out_key: wp.array(dtype=wp.uint32),
    out_tally: wp.array(dtype=int),
): ...


@wp.func_native(PLACE)
def place_share(
    begin: int,
    share: int,
    keys: wp.array(dtype=wp.uint32),
    tally: wp.array(dtype=int),
    out_pairs: wp.array(dtype=wp.uint64),
): ...


@wp.func_native(SORT)
def sort_bucket(
    bucket: int,
    start: wp.array(dtype=int),
    pairs: wp.array(dtype=wp.uint64),
    spare: wp.array(dtype=wp.uint64),
    out_order: wp.array(dtype=int),
): ...


@wp.kernel
def tally_kernel(
    first: int,
    share: int,
    points: wp.array(dtype=wp.vec3d),
    lower: wp.vec3d,
    inverse_extent: wp.float64,
    out_key: wp.array(dtype=wp.uint32),
    out_tally: wp.array(dtype=int),
):
    """Keys of a share of the points, and how many are in each bucket; ``out_tally`` has a row for each share."""
    tally_share((first + wp.tid()) * share, share, points, lower, inverse_extent, out_key, out_tally)


@wp.kernel
def place_kernel(
    first: int,
    share: int,
    keys: wp.array(dtype=wp.uint32),
    tally: wp.array(dtype=int),
    out_pairs: wp.array(dtype=wp.uint64),
):
    """Puts what is left of each key, and whose it is, into its bucket; moves the places in ``tally`` on."""
    place_share((first + wp.tid()) * share, share, keys, tally, out_pairs)


@wp.kernel
def sort_kernel(
    first: int,
    start: wp.array(dtype=int),
    pairs: wp.array(dtype=wp.uint64),
    spare: wp.array(dtype=wp.uint64),
    out_order: wp.array(dtype=int),
):
    """The points of a bucket in the order of their keys."""
    sort_bucket(first + wp.tid(), start, pairs, spare, out_order)
