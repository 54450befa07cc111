"""Multipole moments of the CPU tree's nodes: the far field of a cluster of triangles.

The winding number of a cluster around a point q is ``w = -1/(4 pi) sum over l of (2l-1)!! / (l-1)! * H_l(r) /
|r|^(2l+1)``, r = q - center: H_l is the harmonic part of the homogeneous polynomial ``S_l(v) = integral of (N . v)
(x . v)^(l-1)`` over the cluster's area, N its unit normals and x positions relative to the center (a dipole for l = 1).
Three orders are kept. A harmonic polynomial is determined by its terms without z and with z to the first power, so that
order l takes 2l + 1 numbers: 15 in all, where symmetric tensors have 19 and full ones 39.
"""

# mypy: ignore-errors
import numpy as np
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.tree_kernels import SurfaceTree

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Rows of eight in a node, a column for each child: center 0-2, squared radius 3; x y z 4-6; xx xy yy xz yz 7-11;
# xxx xxy xyy yyy xxz xyz yyz 12-18.
MOMENT_ROWS = 19
# float64 numbers of a node, kept until its parent is done: center, area, radius, S_1 (3), S_2 (6), S_3 (10).
RAW_SIZE = 24
# Added to all radii: float32 moves centers and queries by a few 1e-8, and a cluster of radius zero would be a pole.
RADIUS_SLACK = 1.0e-7
# Center of an absent child: far, and finite to the seventh power in float32.
NOWHERE = np.float32(1.0e5)


@cpp.func_native(
    "mesh/bvh/bvh8_moments_cpu.inl",
    SurfaceTree,
    RAW_SIZE=RAW_SIZE,
    MOMENT_ROWS=MOMENT_ROWS,
    RADIUS_SLACK=RADIUS_SLACK,
    NOWHERE=NOWHERE,
)
def node_moments(): ...


@wp.struct
class TreeMoments:
    """The moments of one of many trees.

    ``flipped`` marks triangles whose winding counts as reversed; an empty array means none. ``areas`` gets, for each
    slot, minus twice the area, with the opposite sign for flipped triangles.
    """

    tree: SurfaceTree
    flipped: wp.array(dtype=wp.bool)
    raw: wp.array(dtype=wp.float64)
    moments: wp.array(dtype=wp.float32)
    areas: wp.array(dtype=wp.float32)


@wp.kernel
def moments_kernel(
    first: int, nodes: wp.array(dtype=int), owner: wp.array(dtype=int), trees: wp.array(dtype=TreeMoments)
):
    """Moments of the children of some nodes, whose own inner nodes must be done; written into ``trees``.

    ``nodes`` count from the root of their tree, the ``owner``.
    """
    i = first + wp.tid()
    one = trees[owner[i]]
    node_moments(one.tree, one.flipped, nodes[i], one.raw, one.moments, one.areas)
