"""Which voxels of a leaf lie inside: a few of them are asked, and their answers spread over bits.

A leaf's voxels are 512 bits, eight words of 64: word ``x``, bit ``8 y + z``. Two neighbours whose distances add up to
more than their spacing cannot have the surface between them; such links are bits too, and a flood is shifts and ands.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# Regions of a leaf that are asked for at their farthest voxel; a surface seldom leaves more.
REGIONS = 4
# Share of the spacing that a region's farthest voxel must have: what is nearer is left to its diagonal neighbours.
LEAST_SHARE = 0.3

# Distances of eight voxels in a row, compared with what comes `step` voxels later.
_LINKS = """
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
    typedef float v8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef int i8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef bool b8 __attribute__((ext_vector_type(8)));
    auto bits = [](i8 lanes) {
        return (unsigned long long)__builtin_bit_cast(unsigned char, __builtin_convertvector(lanes, b8));
    };
    for (int r = 0; r < 8; ++r) {
        const v8 here = *(const v8*)(d + 8 * r);
        const v8 shifted = __builtin_shufflevector(here, here, 1, 2, 3, 4, 5, 6, 7, 7);
        z |= (bits(here + shifted > spacing) & 0x7f) << 8 * r;
        if (r < 7) y |= bits(here + *(const v8*)(d + 8 * r + 8) > spacing) << 8 * r;
        if (x < 7) next |= bits(here + *(const v8*)(d + 8 * r + 64) > spacing) << 8 * r;
    }
    #endif
    unsigned long long* out = (unsigned long long*)out_links.data + 24ll * leaf + 3 * x;
    out[0] = z; out[1] = y; out[2] = next;
"""


@wp.func_native(_LINKS)
def write_links(
    leaf: int,
    x: int,
    rows: wp.array(dtype=int),
    distance: wp.array2d(dtype=wp.float32),
    spacing: float,
    out_links: wp.array2d(dtype=wp.uint64),
): ...


@wp.kernel
def links_kernel(
    first: int,
    rows: wp.array(dtype=int),
    distance: wp.array2d(dtype=wp.float32),
    spacing: float,
    out_links: wp.array2d(dtype=wp.uint64),
):
    """For each plane of a leaf: links to the next voxel along z, along y, and to the next plane."""
    i = first + wp.tid()
    write_links(i >> 3, i & 7, rows, distance, spacing, out_links)


# What a flood from `seed` reaches among the voxels of `open`: expects links (24 words), fills region (8 words).
_FLOOD = """
    auto flood = [](const unsigned long long* links, const unsigned long long* open, int seed,
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
"""

_REGIONS = (
    _FLOOD
    + f"""
    const unsigned long long* known = (const unsigned long long*)known_bits.data + 8ll * leaf;
    const unsigned long long* links = (const unsigned long long*)all_links.data + 24ll * leaf;
    const float* d = distance.data + 512ll * rows.data[leaf];
    unsigned long long open[8], region[8];
    for (int x = 0; x < 8; ++x) open[x] = ~known[x];
    for (int n = 0; n < {REGIONS}; ++n) {{
        int farthest = -1;
        float largest = least;
        for (int x = 0; x < 8; ++x)
            for (int b = 0; open[x] && b < 64; ++b)
                if (open[x] >> b & 1) {{
                    // Where a distance is cut off the search would be wide: such a voxel only where there is no other.
                    const float here = d[64 * x + b] < reach ? d[64 * x + b] : least;
                    if (!(here >= largest) || (farthest >= 0 && here == largest)) continue;
                    largest = here;
                    farthest = 64 * x + b;
                }}
        out_seed.data[{REGIONS}ll * leaf + n] = farthest;
        if (farthest < 0) continue;
        flood(links, open, farthest, region);
        for (int x = 0; x < 8; ++x) open[x] &= ~region[x];
    }}
"""
)


@wp.func_native(_REGIONS)
def find_regions(
    leaf: int,
    rows: wp.array(dtype=int),
    distance: wp.array2d(dtype=wp.float32),
    all_links: wp.array2d(dtype=wp.uint64),
    known_bits: wp.array2d(dtype=wp.uint64),
    least: float,
    reach: float,
    out_seed: wp.array(dtype=int),
): ...


@wp.kernel
def regions_kernel(
    first: int,
    rows: wp.array(dtype=int),
    distance: wp.array2d(dtype=wp.float32),
    links: wp.array2d(dtype=wp.uint64),
    known: wp.array2d(dtype=wp.uint64),
    least: float,
    reach: float,
    out_seed: wp.array(dtype=int),
):
    """The farthest voxel within reach of each region of a leaf, that of the farthest first; -1 where there is none.

    Voxels nearer to the surface than ``least`` start no region; any does for a region that lies beyond reach.
    """
    find_regions(first + wp.tid(), rows, distance, links, known, least, reach, out_seed)


_SPREAD = (
    _FLOOD
    + f"""
    unsigned long long* known = (unsigned long long*)out_known.data + 8ll * leaf;
    unsigned long long* inside = (unsigned long long*)out_inside.data + 8ll * leaf;
    const unsigned long long* links = (const unsigned long long*)all_links.data + 24ll * leaf;
    const float* d = distance.data + 512ll * rows.data[leaf];
    unsigned long long open[8], region[8];
    for (int x = 0; x < 8; ++x) open[x] = ~known[x];
    for (int n = 0; n < {REGIONS}; ++n) {{
        const int seed = seeds.data[{REGIONS}ll * leaf + n];
        if (seed < 0) continue;
        const bool within = answers.data[{REGIONS}ll * leaf + n];
        flood(links, open, seed, region);
        for (int x = 0; x < 8; ++x) {{
            open[x] &= ~region[x];
            known[x] |= region[x];
            if (within) inside[x] |= region[x];
        }}
    }}
    // Diagonal neighbours are farther apart, and one of them lies nearly straight away from the surface.
    const float edge = spacing * 1.41421356f, corner = spacing * 1.73205081f;
    for (int round = 0; round < rounds; ++round)
        for (int x = 0; x < 8; ++x)
            for (unsigned long long left = ~known[x]; left; left &= left - 1) {{
                #if defined(__CUDA_ARCH__)
                const int b = __ffsll((long long)left) - 1;
                #else
                const int b = __builtin_ctzll(left);
                #endif
                const int y = b >> 3, z = b & 7;
                const float here = d[64 * x + b];
                bool found = false;
                for (int n = 0; n < 27 && !found; ++n) {{
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
                }}
            }}
"""
)


@wp.func_native(_SPREAD)
def spread(
    leaf: int,
    rows: wp.array(dtype=int),
    distance: wp.array2d(dtype=wp.float32),
    all_links: wp.array2d(dtype=wp.uint64),
    seeds: wp.array(dtype=int),
    answers: wp.array(dtype=wp.bool),
    spacing: float,
    rounds: int,
    out_known: wp.array2d(dtype=wp.uint64),
    out_inside: wp.array2d(dtype=wp.uint64),
): ...


@wp.kernel
def spread_kernel(
    first: int,
    rows: wp.array(dtype=int),
    distance: wp.array2d(dtype=wp.float32),
    links: wp.array2d(dtype=wp.uint64),
    seeds: wp.array(dtype=int),
    answers: wp.array(dtype=wp.bool),
    spacing: float,
    rounds: int,
    out_known: wp.array2d(dtype=wp.uint64),
    out_inside: wp.array2d(dtype=wp.uint64),
):
    """Spreads the answers over their regions, then, in rounds, to voxels that only a diagonal neighbour tells."""
    leaf = first + wp.tid()
    spread(leaf, rows, distance, links, seeds, answers, spacing, rounds, out_known, out_inside)


@wp.func
def voxel_position(tile: wp.vec3i, voxel: int, translation: wp.vec3d, voxel_size: wp.float64) -> wp.vec3d:
    """World position of voxel ``64 x + 8 y + z`` of a tile."""
    index = wp.vec3d(
        wp.float64(8 * tile[0] + (voxel >> 6)),
        wp.float64(8 * tile[1] + ((voxel >> 3) & 7)),
        wp.float64(8 * tile[2] + (voxel & 7)),
    )
    return index * voxel_size + translation


@wp.kernel
def seed_bits_kernel(first: int, regions: int, seeds: wp.array(dtype=int), out_bits: wp.array2d(dtype=wp.uint64)):
    """Bits of the voxels that the regions of a leaf start from."""
    leaf = first + wp.tid()
    for n in range(regions):
        seed = seeds[regions * leaf + n]
        if seed >= 0:
            out_bits[leaf, seed >> 6] = out_bits[leaf, seed >> 6] | (wp.uint64(1) << wp.uint64(seed & 63))


@wp.kernel
def seed_answers_kernel(
    first: int,
    regions: int,
    seeds: wp.array(dtype=int),
    inside: wp.array2d(dtype=wp.uint64),
    out_answers: wp.array(dtype=wp.bool),
):
    i = first + wp.tid()
    seed = seeds[i]
    if seed >= 0:
        out_answers[i] = ((inside[i / regions, seed >> 6] >> wp.uint64(seed & 63)) & wp.uint64(1)) != wp.uint64(0)


@wp.kernel
def count_bits_kernel(first: int, bits: wp.array2d(dtype=wp.uint64), out_count: wp.array(dtype=int)):
    leaf = first + wp.tid()
    count = int(0)
    for x in range(8):
        word = bits[leaf, x]
        while word != wp.uint64(0):
            word = word & (word - wp.uint64(1))
            count += 1
    out_count[leaf] = count


@wp.func_native("return ~((const unsigned char*)bits.data)[64ll * leaf + row] & 0xff;")
def unset_in_row(bits: wp.array2d(dtype=wp.uint64), leaf: int, row: int) -> int:
    """Bits of the eight voxels in a row of a leaf, ``8 x + y``, that are not set: a byte of a word."""
    ...


@wp.func_native("((unsigned char*)bits.data)[64ll * leaf + row] |= (unsigned char)more;")
def set_in_row(bits: wp.array2d(dtype=wp.uint64), leaf: int, row: int, more: int): ...


@wp.func
def bit_at(word: wp.uint64, place: int) -> bool:
    return ((word >> wp.uint64(place)) & wp.uint64(1)) != wp.uint64(0)


@wp.kernel
def bit_positions_kernel(
    first: int,
    bits: wp.array2d(dtype=wp.uint64),
    ends: wp.array(dtype=int),
    counts: wp.array(dtype=int),
    tiles: wp.array(dtype=wp.vec3i),
    rows: wp.array(dtype=int),
    translation: wp.vec3d,
    voxel_size: wp.float64,
    out_points: wp.array(dtype=wp.vec3d),
):
    """Positions of the voxels whose bits are set."""
    leaf = first + wp.tid()
    at = ends[leaf] - counts[leaf]
    for x in range(8):
        word = bits[leaf, x]
        if word != wp.uint64(0):
            for b in range(64):
                if bit_at(word, b):
                    out_points[at] = voxel_position(tiles[rows[leaf]], 64 * x + b, translation, voxel_size)
                    at += 1


@wp.kernel
def take_answers_kernel(
    first: int,
    bits: wp.array2d(dtype=wp.uint64),
    ends: wp.array(dtype=int),
    counts: wp.array(dtype=int),
    answers: wp.array(dtype=wp.bool),
    out_known: wp.array2d(dtype=wp.uint64),
    out_inside: wp.array2d(dtype=wp.uint64),
):
    """Writes the answers for the voxels whose bits are set."""
    leaf = first + wp.tid()
    at = ends[leaf] - counts[leaf]
    for x in range(8):
        word = bits[leaf, x]
        if word != wp.uint64(0):
            inside = out_inside[leaf, x]
            for b in range(64):
                if bit_at(word, b):
                    if answers[at]:
                        inside = inside | (wp.uint64(1) << wp.uint64(b))
                    at += 1
            out_inside[leaf, x] = inside
            out_known[leaf, x] = out_known[leaf, x] | word


@wp.kernel
def invert_bits_kernel(first: int, bits: wp.array2d(dtype=wp.uint64), out_bits: wp.array2d(dtype=wp.uint64)):
    leaf = first + wp.tid()
    for x in range(8):
        out_bits[leaf, x] = ~bits[leaf, x]


@wp.kernel
def common_bits_kernel(
    first: int, a: wp.array2d(dtype=wp.uint64), b: wp.array2d(dtype=wp.uint64), out_bits: wp.array2d(dtype=wp.uint64)
):
    leaf = first + wp.tid()
    for x in range(8):
        out_bits[leaf, x] = a[leaf, x] & b[leaf, x]
