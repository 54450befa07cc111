"""Generalized winding numbers and the signs that follow from them.

On a CPU the tree is traversed with eight children or triangles at a time: clusters far enough away contribute by their
multipole moments, nearby triangles by their solid angles. On CUDA warp's own tree of solid angles is used.
"""

# mypy: ignore-errors
import numpy as np
import warp as wp

from geokit.core import cpp
from geokit.core.interop.user_arrays_kernels import is_measurable
from geokit.core.morton_order_kernels import prefetch_query
from geokit.mesh.bvh.bvh8_build_cpu_kernels import STACK
from geokit.mesh.bvh.bvh8_moments_kernels import MOMENT_ROWS
from geokit.mesh.bvh.leaf_planes_kernels import PLANE_ROWS
from geokit.mesh.bvh.tree_kernels import SurfaceTree

wp.set_module_options({"enable_backward": False})

# A cluster contributes by its moments if the query is farther away than this many of its radii. The error of three
# orders falls with about the fourth power: 0.005 at 2, 0.002 at 2.5, 0.001 at 3, which opens half as many nodes again.
OPENING = np.float32(2.5)
# A sign needs much less: this opens a quarter of the nodes, with an error of at most 0.05 on simple surfaces.
OPENING_SIGN = np.float32(1.25)
# If the coarse sum is nearer to 1/2 than this, the fine sum decides.
SIGN_MARGIN = 0.1
# The margin grows by this times the sum of the last order's absolute terms. That sum estimates the error of the coarse
# sum, to which many coincident surfaces add theirs.
SIGN_SPREAD = 2.0
# Nearer than this many local units to a triangle (to its rectangle, in its plane), its solid angle is computed in
# float64: float32 positions have an error of 4e-7, which changes the angle at an edge by up to 4e-7 / NEAR.
NEAR = np.float32(1.0e-4)
# The same applies if the sine and the cosine of the angle are smaller than this, being differences of larger terms:
# close to an edge in relation to its length, and farther out around slivers. Their rounding errors are some 5e-7.
SMALL = np.float32(1.0e-3)
# In the plane of a triangle, the cosine (of an angle of 0 or pi) is negative inside, and zero on the edges except for
# the rounding of its terms in float64; this share of the terms covers that rounding.
ON_SURFACE = 1.0e-15
# Farther away than this many local units, the winding number is zero in float32.
FAR = 1.0e6
# On CUDA a node of warp's tree counts as one dipole if the query is farther away than this many of its radii. 2 agrees
# with exact sums on clean, holed and overlapping meshes; 0.5 is wrong for a quarter of near points; 4 takes 2.4 times
# as long.
ACCURACY = np.float32(2.0)
# Queue of nodes in breadth-first order, so that the processor works on several at once; nodes that do not fit are
# visited depth first.
QUEUE = 1024
# Leaves that are deferred until the nodes are done.
LEAVES = 512


@wp.struct
class WindingTree:
    """Data for winding numbers beside the tree of a surface; on CUDA only the handle is set."""

    # Handle of the warp Mesh whose faces have the winding that counts.
    mesh: wp.uint64
    # For each node MOMENT_ROWS rows of eight; see bvh8_moments_kernels.
    moments: wp.array(dtype=wp.float32)
    # Minus twice the signed area of the triangle in each slot.
    areas: wp.array(dtype=wp.float32)


_CONSTANTS = {
    "FAR": FAR,
    "ACCURACY": ACCURACY,
    "OPENING": OPENING,
    "NEAR": NEAR,
    "SMALL": SMALL,
    "ON_SURFACE": ON_SURFACE,
    "PLANE_ROWS": PLANE_ROWS,
    "MOMENT_ROWS": MOMENT_ROWS,
    "QUEUE": QUEUE,
    "LEAVES": LEAVES,
    "STACK": STACK,
    "OPENING_SIGN": OPENING_SIGN,
    "SIGN_MARGIN": SIGN_MARGIN,
    "SIGN_SPREAD": SIGN_SPREAD,
}


@cpp.func_native("mesh/bvh/winding.inl", **_CONSTANTS)
def winding_number_at(tree: SurfaceTree, winding: WindingTree, empty: wp.float64, p: wp.vec3d) -> wp.float64:
    """Winding number around the world point p.

    It is exactly zero outside the cube of half width ``empty`` local units: 1 for closed meshes, infinite for others.
    """
    ...


@cpp.func_native("mesh/bvh/winding.inl", **_CONSTANTS)
def is_inside(tree: SurfaceTree, winding: WindingTree, empty: wp.float64, p: wp.vec3d) -> wp.bool:
    """Whether the winding number exceeds 1/2 and p is not on the surface; several times faster than the number."""
    ...


@wp.kernel
def winding_number_kernel(
    first: int,
    order: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    winding: WindingTree,
    empty: wp.float64,
    out_winding: wp.array(dtype=wp.float64),
    out_nonfinite: wp.array(dtype=int),
):
    """A query that is not finite, or too far away, has none and raises ``out_nonfinite``; the host finds the row."""
    prefetch_query(points, order, first + wp.tid())
    i = order[first + wp.tid()]
    p = points[i]
    if is_measurable(p):
        out_winding[i] = winding_number_at(tree, winding, empty, p)
    else:
        out_winding[i] = wp.float64(wp.nan)
        out_nonfinite[0] = 1


@wp.kernel
def sign_kernel(
    first: int,
    order: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    winding: WindingTree,
    empty: wp.float64,
    out_distance: wp.array(dtype=wp.float64),
):
    """Negate the distances of inside points in place."""
    prefetch_query(points, order, first + wp.tid())
    i = order[first + wp.tid()]
    if is_inside(tree, winding, empty, points[i]):
        out_distance[i] = -out_distance[i]
