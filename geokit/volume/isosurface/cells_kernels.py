"""Finds the voxels inside an isosurface, the cells that it crosses, and the neighbors of their blocks.

A cell has the number of its lowest voxel and belongs to the block of 8^3 cells that starts at that voxel's leaf. Signs
are bit masks: plane x of a block is a word of 64 voxels whose bit ``8 y + z`` means "inside", so shifted words compare
the voxels of 64 cells at once. Only functions that read values depend on their type.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.nanovdb.read_voxel_kernels import grid_type_of, is_leaf, node_of, read_voxel
from geokit.volume.sampling.active_kernels import is_active

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Words of a plane's record: bit masks of the cells with at least 1, 2, 3 and 4 sheets of the surface.
RECORD = 4
# A reference to a tile instead of a leaf is -1 - (inside + 2 * active).
INSIDE_TILE, ACTIVE_TILE = wp.constant(1), wp.constant(2)


@wp.struct
class Cells:
    """The blocks that a surface may cross: the leaves, then blocks of tiles beside them ("border blocks")."""

    volume: wp.uint64  # address of the grid
    values: wp.uint64  # address of the first leaf's values, float32
    stride: wp.uint64  # bytes from a leaf's values to the next one's
    isovalue: wp.float64  # in the units of the float32 values
    leaf_count: int
    leaf_offset: wp.array(dtype=wp.uint64)  # bytes from the grid's start to each leaf
    origin: wp.array(dtype=wp.vec3i)  # first voxel of each block
    sides: wp.array(dtype=wp.uint64)  # 8 planes per block: bit masks of the inside voxels
    border_active: wp.array(dtype=wp.uint8)  # whether each border block is active
    refs: wp.array(dtype=int)  # 8 per block: the blocks at + (dx, dy, dz), number 4 dx + 2 dy + dz; tiles negative
    crossed: wp.array(dtype=int)  # blocks with crossed cells
    slot: wp.array(dtype=int)  # place of each block in `crossed`, or -1


@wp.struct
class Tree:
    """Lower nodes and their neighbors, for steps from leaf to leaf without the root."""

    begin: wp.uint64  # bytes from the grid's start to the lower nodes
    size: wp.uint64  # bytes of a lower node
    table: wp.uint64  # bytes from a lower node to its slots
    leaf_begin: wp.uint64
    leaf_size: wp.uint64  # 0 if leaves differ in size
    tile_inside: wp.array(dtype=wp.uint64)  # 64 words per lower node: bit mask of the tiles inside
    around: wp.array(dtype=int)  # 27 per lower node: lower nodes, tiles negative
    leaf_lower: wp.array(dtype=int)  # lower node of each leaf, and the leaf's slot in it
    leaf_slot: wp.array(dtype=int)


@cpp.func_native("volume/isosurface/cells.inl")
def lower_at(volume: wp.uint64, grid_type: int, tree: Tree, i: int, j: int, k: int) -> wp.int64: ...


@cpp.func_native("volume/isosurface/cells.inl")
def leaf_at(cells: Cells, tree: Tree, node: wp.uint64) -> int:
    """The number of a leaf, from its node as node_of returns it."""
    ...


@cpp.func_native("volume/isosurface/cells.inl")
def find_border_block(cells: Cells, border_count: int, i: int, j: int, k: int) -> int:
    """The border block that starts at a voxel, -1 for none."""
    ...


@wp.func
def value_at(volume: wp.uint64, i: int, j: int, k: int) -> wp.float64:
    kind = grid_type_of(volume)
    return read_voxel(volume, kind, node_of(volume, kind, i, j, k), i, j, k, wp.float64(0.0))


@wp.func
def tile_ref(volume: wp.uint64, isovalue: wp.float64, i: int, j: int, k: int) -> int:
    """The reference to a tile, from its value and active state."""
    code = 0
    if value_at(volume, i, j, k) < isovalue:
        code += INSIDE_TILE
    if is_active(volume, i, j, k):
        code += ACTIVE_TILE
    return -1 - code


@wp.kernel
@cpp.native_item("volume/isosurface/cells.inl", "leaf_sides")
def leaf_sides_kernel(first: int, cells: Cells, limit: wp.float32):
    """Writes the eight planes of a leaf: bit masks of the voxels below the limit."""


@wp.kernel
@cpp.native_item("volume/isosurface/cells.inl", "row_sides")
def row_sides_kernel(first: int, cells: Cells, limit: wp.float32):
    """Writes a row of eight voxels of a leaf: a byte of a plane."""


@wp.kernel
def decode_kernel(first: int, cells: Cells, isovalue: wp.float64, out_value: wp.array(dtype=wp.float32)):
    """Decodes rows of eight voxels of any type minus the isovalue, and finds which of them are inside."""
    row = first + wp.tid()
    leaf = row / 64
    volume = cells.volume
    kind = grid_type_of(volume)
    node = cells.leaf_offset[leaf] + wp.uint64(1)
    corner = cells.origin[leaf]
    i = corner[0] + (row % 64) / 8
    j = corner[1] + row % 8
    for z in range(8):
        value = read_voxel(volume, kind, node, i, j, corner[2] + z, wp.float64(0.0)) - isovalue
        out_value[8 * row + z] = wp.float32(value)


@wp.kernel
def tile_sides_kernel(
    first: int, volume: wp.uint64, isovalue: wp.float64, tree: Tree, out_inside: wp.array(dtype=wp.uint64)
):
    word = first + wp.tid()
    kind = grid_type_of(volume)
    at = tree.begin + tree.size * wp.uint64(word / 64) + tree.table + wp.uint64((word % 64) * 512)
    bits = wp.uint64(0)
    for n in range(64):
        # Bits of slots with a leaf are set as well, but never read.
        if read_voxel(volume, kind, at + wp.uint64(8 * n), 0, 0, 0, wp.float64(0.0)) < isovalue:
            bits = bits | (wp.uint64(1) << wp.uint64(n))
    out_inside[word] = bits


@wp.kernel
def lower_neighbors_kernel(
    first: int,
    volume: wp.uint64,
    isovalue: wp.float64,
    tree: Tree,
    lower_origin: wp.array(dtype=wp.vec3i),
    out_around: wp.array(dtype=int),
):
    item = first + wp.tid()
    corner = lower_origin[item / 27]
    side = item % 27
    i = corner[0] + 128 * (side / 9 - 1)
    j = corner[1] + 128 * ((side / 3) % 3 - 1)
    k = corner[2] + 128 * (side % 3 - 1)
    node = lower_at(volume, grid_type_of(volume), tree, i, j, k)
    if node >= wp.int64(0):
        out_around[item] = int(node)
    else:
        out_around[item] = tile_ref(volume, isovalue, i, j, k)


@wp.kernel
@cpp.native_item("volume/isosurface/cells.inl", "link_leaf")
def link_kernel(first: int, cells: Cells, tree: Tree):
    """Finds the blocks above each leaf, the tiles below it that may have crossed cells, and whether there are any.

    If there are none, out_mixed equals that of mixed_kernel.
    """


@wp.kernel
@cpp.native_item("volume/isosurface/cells.inl", "mark_mixed")
def mixed_kernel(first: int, cells: Cells): ...


@wp.kernel
def list_kernel(
    first: int,
    mixed: wp.array(dtype=int),
    place: wp.array(dtype=int),
    out_crossed: wp.array(dtype=int),
    out_slot: wp.array(dtype=int),
):
    block = first + wp.tid()
    if mixed[block] != 0:
        out_crossed[place[block]] = block
        out_slot[block] = place[block]
    else:
        out_slot[block] = -1


@wp.kernel
def totals_kernel(
    first: int,
    counts: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    more_counts: wp.array(dtype=int),
    more_starts: wp.array(dtype=int),
    out_totals: wp.array(dtype=int),
):
    """Totals of one or two arrays of counts, from their prefix sums: the last start plus the last count."""
    kind = first + wp.tid()
    last = counts.shape[0] - 1
    if kind == 0:
        out_totals[kind] = starts[last] + counts[last]
    else:
        out_totals[kind] = more_starts[last] + more_counts[last]


@wp.kernel
def mark_used_kernel(first: int, faces: wp.array(dtype=int), out_used: wp.array(dtype=int)):
    """Sets 1 at each vertex that a face uses; the array must be zero before."""
    out_used[faces[first + wp.tid()]] = 1


@wp.kernel
def keep_used_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    used: wp.array(dtype=int),
    place: wp.array(dtype=int),
    out_vertices: wp.array(dtype=wp.vec3d),
):
    """Moves each used vertex to its place, which is the number of used vertices before it."""
    vertex = first + wp.tid()
    if used[vertex] != 0:
        out_vertices[place[vertex]] = vertices[vertex]


# Border blocks: blocks of tiles, beside leaves or other tiles, with crossed cells.
@wp.kernel
@cpp.native_item("volume/isosurface/cells.inl", "mark_tile_border")
def tile_border_kernel(first: int, cells: Cells, tree: Tree): ...


@wp.kernel
def large_tile_border_kernel(
    first: int,
    volume: wp.uint64,
    isovalue: wp.float64,
    origin: wp.array(dtype=wp.vec3i),
    out_below: wp.array(dtype=wp.uint8),
):
    """Does the same as tile_border_kernel, for blocks in tiles larger than a block."""
    item = first + wp.tid()
    corner = origin[item]
    kind = grid_type_of(volume)
    below = int(0)
    for e in range(8):
        low = corner - 8 * wp.vec3i(e / 4, (e / 2) % 2, e % 2)
        some_in = int(0)
        some_out = int(0)
        for d in range(8):
            at = low + 8 * wp.vec3i(d / 4, (d / 2) % 2, d % 2)
            if is_leaf(node_of(volume, kind, at[0], at[1], at[2])):
                if d == 0:
                    break
            elif value_at(volume, at[0], at[1], at[2]) < isovalue:
                some_in = 1
            else:
                some_out = 1
        if some_in + some_out == 2:
            below = below | (1 << e)
    out_below[item] = wp.uint8(below)


@wp.kernel
def border_block_kernel(
    first: int,
    cells: Cells,
    tree: Tree,
    isovalue: wp.float64,
    border_count: int,
    out_sides: wp.array(dtype=wp.uint64),
    out_active: wp.array(dtype=wp.uint8),
    out_refs: wp.array(dtype=int),
):
    """Writes planes, active state and upper neighbors of a border block."""
    border = first + wp.tid()
    block = cells.leaf_count + border
    corner = cells.origin[block]
    volume = cells.volume
    kind = grid_type_of(volume)
    code = -1 - tile_ref(volume, isovalue, corner[0], corner[1], corner[2])
    word = wp.uint64(0)
    if (code & INSIDE_TILE) != 0:
        word = ~word
    for x in range(8):
        out_sides[8 * block + x] = word
    out_active[border] = wp.uint8(code / ACTIVE_TILE)
    for d in range(8):
        at = corner + 8 * wp.vec3i(d / 4, (d / 2) % 2, d % 2)
        node = node_of(volume, kind, at[0], at[1], at[2])
        ref = int(0)
        if is_leaf(node):
            ref = leaf_at(cells, tree, node)
        else:
            ref = find_border_block(cells, border_count, at[0], at[1], at[2])
            if ref < 0:
                ref = tile_ref(volume, isovalue, at[0], at[1], at[2])
        out_refs[8 * block + d] = ref


@wp.kernel
def link_border_blocks_kernel(first: int, cells: Cells, border_count: int, out_refs: wp.array(dtype=int)):
    """Replaces references to tiles above a leaf by the number of the border block there, if there is one."""
    item = first + wp.tid()
    if out_refs[item] < 0:
        d = item % 8
        at = cells.origin[item / 8] + 8 * wp.vec3i(d / 4, (d / 2) % 2, d % 2)
        border = find_border_block(cells, border_count, at[0], at[1], at[2])
        if border >= 0:
            out_refs[item] = border
