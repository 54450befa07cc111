"""Pairs of intersecting triangles: their number for each leaf, then the list; which of many meshes have any.

Triangles that intersect boxes: first their number for each box, then the list.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.core.atomic_kernels import lower_to
from geokit.core.scan_kernels import part_of
from geokit.mesh.bvh.tree_kernels import BOX_CONSTANTS, SurfaceTree, slot_box

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Relative to |axis|_1 times the largest coordinate. A dot product of differences has an error of five roundings, and
# two of them are compared; this is about twice that.
PAIR_GAP_ERROR = 2.5e-15
# Relative to the sum of the absolute products: (7 + 56 e) e and (3 + 16 e) e for e = 2^-53 (Shewchuk 1997), with slack
# for the rounding of that sum.
VOLUME_ERROR = 8.0e-16
AREA_ERROR = 3.4e-16
# Six triple products of differences. A difference has two parts, so each product has eight terms of four parts each.
PARTS = 192
# Cosine from which on two faces face each other: 26 degrees from opposed. It is a guess: walls rough within the margin
# touch at other angles too. So it only saves work, and what is made is judged all the same (mesh/solids/contact.py).
FACING = 0.9
# Relative to the sizes compared along a separating axis: five roundings on each side of the comparison, with slack.
OVERLAP_CONSTANTS = {**BOX_CONSTANTS, "BOX_GAP_ERROR": 3.0e-15}

PAIR_CONSTANTS = {
    "PAIR_GAP_ERROR": PAIR_GAP_ERROR,
    "VOLUME_ERROR": VOLUME_ERROR,
    "AREA_ERROR": AREA_ERROR,
    "PARTS": PARTS,
    "FACING": FACING,
}


@cpp.func_native("mesh/queries/intersecting.inl", SurfaceTree, **BOX_CONSTANTS, **PAIR_CONSTANTS)
def find_pair(): ...


@wp.kernel
@cpp.native_item("mesh/queries/intersecting.inl", "count_pairs", SurfaceTree, **BOX_CONSTANTS, **PAIR_CONSTANTS)
def count_pairs_kernel(first: int): ...


@wp.kernel
@cpp.native_item("mesh/queries/intersecting.inl", "fill_pairs", SurfaceTree, **BOX_CONSTANTS, **PAIR_CONSTANTS)
def fill_pairs_kernel(first: int):
    """Write the pairs of the items that have any, each item from its offset in the list."""


@wp.kernel
@cpp.native_item("mesh/queries/intersecting.inl", "find_pair", SurfaceTree, **BOX_CONSTANTS, **PAIR_CONSTANTS)
def find_pair_kernel(first: int):
    """Whether there is any pair; all threads stop once one is found."""


@wp.kernel
@cpp.native_item("mesh/queries/intersecting.inl", "find_facing", SurfaceTree, **BOX_CONSTANTS, **PAIR_CONSTANTS)
def find_facing_kernel(first: int): ...


@wp.struct
class ForestBoxes:
    """What a search for the self-intersections of one tree needs."""

    tree: SurfaceTree
    slot_boxes: wp.array(dtype=wp.float32)
    # 1 as soon as a pair is found.
    found: wp.array(dtype=int)
    # A power of two near the inverse of the scale.
    unit: wp.float64


@wp.kernel
def forest_slot_boxes_kernel(first: int, begin: wp.array(dtype=int), forest: wp.array(dtype=ForestBoxes)):
    """As slot_boxes_kernel; ``begin`` has the first slot of each tree, and their number. Writes into the forest."""
    slot = first + wp.tid()
    tree = part_of(begin, slot)
    one = forest[tree]
    slot_box(one.tree, slot - begin[tree], one.slot_boxes)


@wp.kernel
def forest_pairs_kernel(
    first: int, trees: wp.array(dtype=int), leaves: wp.array(dtype=int), forest: wp.array(dtype=ForestBoxes)
):
    """One item is a leaf of a tree. Raises ``found`` in the forest."""
    i = first + wp.tid()
    one = forest[trees[i]]
    find_pair(leaves[i], one.tree, one.tree, one.slot_boxes, True, one.unit, one.found)


@wp.kernel
@cpp.native_item("mesh/queries/overlaps.inl", "count_overlaps", SurfaceTree, **OVERLAP_CONSTANTS)
def count_overlaps_kernel(first: int): ...


@wp.kernel
@cpp.native_item("mesh/queries/overlaps.inl", "list_overlaps", SurfaceTree, **OVERLAP_CONSTANTS)
def list_overlaps_kernel(first: int): ...


@wp.kernel
def first_inverted_kernel(
    first: int, lower: wp.array(dtype=wp.vec3d), upper: wp.array(dtype=wp.vec3d), out_row: wp.array(dtype=int)
):
    i = first + wp.tid()
    for k in range(3):
        if lower[i][k] > upper[i][k]:
            lower_to(out_row, 0, i)


@wp.kernel
def triangle_of_key_kernel(first: int, key: wp.array(dtype=wp.int64), out_triangle_id: wp.array(dtype=int)):
    i = first + wp.tid()
    out_triangle_id[i] = wp.int32(key[i] & wp.int64(0xFFFFFFFF))
