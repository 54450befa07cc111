"""The levels of an adaptive field as a kernel struct, and the bit masks of their refined cells.

A cell of the next level is found by doubling a cell's index and adding the level's ``shift``. This is exact, so the
cell around a point never depends on rounding at another level.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.sampling.leaf_table_kernels import LeafTable

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


@wp.struct
class AdaptiveLevels:
    """An adaptive field: its levels, the coarsest first, and the bit masks of their refined cells."""

    tables: wp.array(dtype=LeafTable)
    # A bit for each cell of each leaf, 16 words per leaf: whether the cell is refined. For each level: its first word,
    # and the entry of the leaf that this word belongs to.
    finer: wp.array(dtype=wp.uint32)
    first_word: wp.array(dtype=wp.int64)
    first_entry: wp.array(dtype=int)
    # For each level: how far the entries of two leaves are apart at least, and the grid's handle.
    step: wp.array(dtype=int)
    volume: wp.array(dtype=wp.uint64)
    # Twice a cell's index plus the shift of its level is the index of its first half in the next level.
    shift: wp.array(dtype=wp.vec3i)


@cpp.func_native("volume/sampling/leaf_table.inl")
def leaf_corner(table: LeafTable, entry: int) -> wp.vec3i:
    """First voxel of the leaf of an entry."""
    ...


@cpp.func_native("volume/sampling/leaf_table.inl")
def holds_active(table: LeafTable, i: int, j: int, k: int) -> bool:
    """Whether the voxel (i, j, k) lies in a leaf and is active there."""
    ...


@wp.func
def has_halves(finer: LeafTable, c: wp.vec3i, low: int, high: int) -> bool:
    """Whether the voxels that the eight halves of a cell read, ``low`` to ``high`` along each axis, are all active.

    ``c`` is the first voxel of the first half.
    """
    # At order 1 the middle voxel belongs to this cell alone: if it is not active, the others need no test.
    if not holds_active(finer, c[0] + 1, c[1] + 1, c[2] + 1):
        return False
    for i in range(low, high + 1):
        for j in range(low, high + 1):
            for k in range(low, high + 1):
                if not holds_active(finer, c[0] + i, c[1] + j, c[2] + k):
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
    step: int,
    low: int,
    high: int,
    out_bits: wp.array(dtype=wp.uint32),
):
    """A word for 32 cells of a leaf, z fastest: a bit for each refined cell."""
    t = first + wp.tid()
    entry = entries[t / 16]
    word = t % 16
    corner = leaf_corner(coarser, entry)
    bits = wp.uint32(0)
    for n in range(32):
        c = corner + wp.vec3i(word / 2, word % 2 * 4 + n / 8, n % 8)
        if has_halves(finer, 2 * c + shift, low, high):
            bits = bits | (wp.uint32(1) << wp.uint32(n))
    out_bits[16 * ((entry - first_entry) / step) + word] = bits
