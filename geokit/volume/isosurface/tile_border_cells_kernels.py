"""Kernels that find border blocks: blocks of tiles, beside leaves or other tiles, with crossed cells."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.volume.isosurface.cells_kernels import (
    ACTIVE_TILE,
    INSIDE_TILE,
    Cells,
    Tree,
    leaf_at,
    tile_ref,
    value_at,
)
from geokit.volume.nanovdb.read_voxel_kernels import grid_type_of, is_leaf, node_of

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})


@cpp.func_native("volume/isosurface/cells.inl")
def tile_border(cells: Cells, tree: Tree, lower: int, slot: int) -> int:
    """The active tile in a slot and the tiles below it that may have crossed cells, a bit per direction."""
    ...


@cpp.func_native("volume/isosurface/cells.inl")
def find_border_block(cells: Cells, border_count: int, i: int, j: int, k: int) -> int:
    """The border block that starts at a voxel, -1 for none."""
    ...


@wp.kernel
def tile_border_kernel(
    first: int,
    cells: Cells,
    tree: Tree,
    lower: wp.array(dtype=int),
    slot: wp.array(dtype=int),
    out_below: wp.array(dtype=wp.uint8),
):
    tile = first + wp.tid()
    out_below[tile] = wp.uint8(tile_border(cells, tree, lower[tile], slot[tile]))


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
