"""A table that finds the leaves of a float grid without a walk down the tree: one 32-bit entry per 8^3 voxels.

NanoVDB finds a voxel through the root's table and two nodes, each with a mask and a 64-bit table, of 302 and 35 kB.
This table is dense over a box around the active voxels. It holds one number for each 128^3 voxels, and a block of 16^3
entries where there are leaves: 16 kB that stay in the cache. The voxels themselves stay in the grid's own buffer.

The entry of a leaf is its byte offset divided by 32. The entry of a tile is ~(byte offset of its value / 4).
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.nanovdb.read_voxel_kernels import grid_type_of, is_leaf, node_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Entries of a block, and pairs of a leaf.
BLOCK = wp.constant(4096)
PAIRS = wp.constant(648)


@wp.struct
class LeafTable:
    """Locations of the leaves of a float grid.

    ``top`` has one number for each 128^3 voxels of the box: the first of their entries in ``slots``, or the entry of
    the single tile that covers them, which is negative.
    """

    # Address of the grid.
    grid: wp.uint64
    # First voxel of the box, a multiple of 128, and its size in steps of 128 voxels.
    lower: wp.vec3i
    size: wp.vec3i
    # z fastest.
    top: wp.array(dtype=int)
    slots: wp.array(dtype=int)
    # A second copy of the leaves, on GPUs with enough memory: (9, 8, 9) pairs of a voxel and the next along y, for the
    # cells that begin in a leaf. ``first_leaf`` is the entry of the first leaf; entries grow by 67 per leaf.
    pairs: wp.array(dtype=wp.float32)
    first_leaf: int


@cpp.func_native("volume/sampling/leaf_table.inl")
def level_of(volume: wp.uint64, i: int, j: int, k: int) -> int:
    """The tree level that holds the value of a voxel: 0 leaf, 1 lower node, 2 upper node, 3 and more the root."""
    ...


@wp.func
def corner_of(t: int, lower: wp.vec3i, size: wp.vec3i) -> wp.vec3i:
    """First voxel of place t of the box."""
    z = t % size[2]
    y = t / size[2] % size[1]
    x = t / (size[2] * size[1])
    return lower + 128 * wp.vec3i(x, y, z)


@wp.func
def tile_entry(node: wp.uint64) -> int:
    return -1 - int(node >> wp.uint64(2))


@wp.kernel
def fill_top_kernel(first: int, volume: wp.uint64, lower: wp.vec3i, size: wp.vec3i, out_top: wp.array(dtype=int)):
    """Writes the entry of each place that is one tile, and 0 for places that hold leaves."""
    t = first + wp.tid()
    c = corner_of(t, lower, size)
    entry = int(0)
    if level_of(volume, c[0], c[1], c[2]) > 1:
        entry = tile_entry(node_of(volume, grid_type_of(volume), c[0], c[1], c[2]))
    out_top[t] = entry


@wp.kernel
def fill_slots_kernel(
    first: int,
    volume: wp.uint64,
    lower: wp.vec3i,
    size: wp.vec3i,
    places: wp.array(dtype=int),
    out_slots: wp.array(dtype=int),
):
    t = first + wp.tid()
    c = corner_of(places[t / BLOCK], lower, size)
    s = t % BLOCK
    node = node_of(volume, grid_type_of(volume), c[0] + s / 256 * 8, c[1] + s / 16 % 16 * 8, c[2] + s % 16 * 8)
    if is_leaf(node):
        out_slots[t] = int(node >> wp.uint64(5))
    else:
        out_slots[t] = tile_entry(node)


@cpp.func_native("volume/sampling/leaf_table.inl")
def table_voxel(table: LeafTable, i: int, j: int, k: int) -> wp.float32:
    """The value of voxel (i, j, k), which must lie in the box."""
    ...


@wp.kernel
def leaf_corners_kernel(
    first: int, table: LeafTable, places: wp.array(dtype=int), out_corner: wp.array(dtype=wp.vec3i)
):
    t = first + wp.tid()
    entry = table.slots[t]
    if entry >= 0:
        c = corner_of(places[t / BLOCK], table.lower, table.size)
        s = t % BLOCK
        out_corner[(entry - table.first_leaf) / 67] = c + 8 * wp.vec3i(s / 256, s / 16 % 16, s % 16)


@wp.kernel
def fill_pairs_kernel(
    first: int, table: LeafTable, corner: wp.array(dtype=wp.vec3i), out_pairs: wp.array(dtype=wp.float32)
):
    t = first + wp.tid()
    c = corner[t / PAIRS]
    n = t % PAIRS
    i = c[0] + n / 72
    j = c[1] + n / 9 % 8
    k = c[2] + n % 9
    out_pairs[2 * t] = table_voxel(table, i, j, k)
    out_pairs[2 * t + 1] = table_voxel(table, i, j + 1, k)
