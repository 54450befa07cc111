"""The levels of an adaptive field as kernels see them, and which cells are answered by the next one.

Cells of the next level are found by doubling a cell's index and adding its ``shift``, which is exact: which cell a
point lies in never depends on how rounding falls at another level.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.sampling.leaf_table_kernels import LeafTable

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


_CORNER_SNIPPET = """
    // The first active voxel of the leaf, or of one without any its first: with its low bits cleared the corner.
    const int* const box = (const int*)(table.grid + (unsigned long long)entry * 32ull);
    return wp::vec_t<3, int>(box[0] & ~7, box[1] & ~7, box[2] & ~7);
"""


@wp.func_native(_CORNER_SNIPPET)
def leaf_corner(table: LeafTable, entry: int) -> wp.vec3i:
    """First voxel of the leaf of an entry."""
    ...


_ACTIVE_SNIPPET = """
    const int x = i - table.lower[0], y = j - table.lower[1], z = k - table.lower[2];
    if (x < 0 || y < 0 || z < 0) return false;
    if (x >= table.size[0] * 128 || y >= table.size[1] * 128 || z >= table.size[2] * 128) return false;
    const int start = table.top.data[((x >> 7) * table.size[1] + (y >> 7)) * table.size[2] + (z >> 7)];
    if (start < 0) return false;
    const int entry = table.slots.data[start + (((x >> 3) & 15) << 8 | ((y >> 3) & 15) << 4 | ((z >> 3) & 15))];
    if (entry < 0) return false;
    typedef unsigned long long word;
    const word* const mask = (const word*)(table.grid + (word)entry * 32ull + 16ull);
    return (mask[x & 7] >> ((y & 7) << 3 | (z & 7))) & 1ull;
"""


@wp.func_native(_ACTIVE_SNIPPET)
def is_active(table: LeafTable, i: int, j: int, k: int) -> bool:
    """Whether the voxel (i, j, k) lies in a leaf and is active there."""
    ...


@wp.func
def has_halves(finer: LeafTable, c: wp.vec3i) -> bool:
    """Whether all 27 voxels of the eight halves of a cell are active; c is the first of them."""
    # The one in the middle belongs to this cell alone: where it is not, no other needs to be asked.
    if not is_active(finer, c[0] + 1, c[1] + 1, c[2] + 1):
        return False
    for n in range(27):
        if not is_active(finer, c[0] + n / 9, c[1] + n / 3 % 3, c[2] + n % 3):
            return False
    return True


@wp.kernel
def fill_finer_kernel(
    first: int,
    coarser: LeafTable,
    finer: LeafTable,
    shift: wp.vec3i,
    entries: wp.array(dtype=int),
    first_entry: int,
    out_bits: wp.array(dtype=wp.uint32),
):
    """For 32 cells of a leaf, from x and y on z fastest, a bit for each that the next level answers."""
    t = first + wp.tid()
    entry = entries[t / 16]
    word = t % 16
    corner = leaf_corner(coarser, entry)
    bits = wp.uint32(0)
    for n in range(32):
        c = corner + wp.vec3i(word / 2, word % 2 * 4 + n / 8, n % 8)
        if has_halves(finer, 2 * c + shift):
            bits = bits | (wp.uint32(1) << wp.uint32(n))
    out_bits[16 * ((entry - first_entry) / 67) + word] = bits
