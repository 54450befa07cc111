"""Pairs of intersecting triangles: first their number for each leaf, then the list."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.box_walk_kernels import BOX_CONSTANTS
from geokit.mesh.bvh.tree_kernels import SurfaceTree

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
