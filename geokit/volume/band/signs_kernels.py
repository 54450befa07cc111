"""Finds which voxels of a leaf lie inside: a few are tested, and flood fills spread the answers over bit masks.

The bit mask of a leaf has eight words of 64 bits: word ``x``, bit ``8 y + z``. Two neighbors are linked if their
distances add up to more than their spacing, because the surface cannot lie between them. Links are bit masks too, so a
flood fill is made of shifts and ands.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# Most regions of a leaf that are tested at their farthest voxel; a surface rarely separates more.
REGIONS = 4
# Least distance, as a share of the spacing, of a region's farthest voxel; diagonal neighbors decide nearer voxels.
LEAST_SHARE = 0.3


@wp.kernel
@cpp.native_item("volume/band/signs.inl", "write_links", REGIONS=REGIONS)
def links_kernel(first: int, distance: wp.array2d(dtype=wp.float32), out_links: wp.array2d(dtype=wp.uint64)):
    """Links of each plane of a leaf to the next voxel along z, along y, and to the next plane."""


@wp.kernel
@cpp.native_item("volume/band/signs.inl", "find_regions", REGIONS=REGIONS)
def regions_kernel(
    first: int,
    distance: wp.array2d(dtype=wp.float32),
    all_links: wp.array2d(dtype=wp.uint64),
    known_bits: wp.array2d(dtype=wp.uint64),
):
    """The farthest voxel within reach of each region of a leaf, farthest first; -1 if there is none.

    Voxels nearer to the surface than ``least`` start no region. A region beyond reach starts at any of its voxels.
    """


@wp.kernel
@cpp.native_item("volume/band/signs.inl", "spread_answers", REGIONS=REGIONS)
def spread_kernel(
    first: int,
    distance: wp.array2d(dtype=wp.float32),
    all_links: wp.array2d(dtype=wp.uint64),
    out_known: wp.array2d(dtype=wp.uint64),
    out_inside: wp.array2d(dtype=wp.uint64),
):
    """Spreads the answers over their regions, then in rounds to voxels that only a diagonal neighbor decides."""


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
    """Bit masks of the voxels from which the regions of a leaf start."""
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
    """Inverted bits of the eight voxels in row ``8 x + y`` of a leaf: a byte of a word."""
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
