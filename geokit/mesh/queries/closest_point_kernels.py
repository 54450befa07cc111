"""Closest point on a surface, one query a thread."""

# mypy: ignore-errors
import warp as wp

from geokit.core.interop.user_arrays_kernels import is_measurable
from geokit.core.morton_order_kernels import prefetch_query
from geokit.mesh.bvh.nearest_kernels import nearest_slot
from geokit.mesh.bvh.tree_kernels import SurfaceTree
from geokit.mesh.triangle.closest_kernels import closest_on_triangle, offset_from_triangle

# Without fused multiply-adds a GPU gives the same bits as a CPU, and the same ties between triangles.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Register limit of a GPU thread; see docs/design/launches-and-memory.md.
REGISTERS = 80


@wp.struct
class ClosestPoint:
    """The closest point of a surface. A miss has triangle_id -1, an infinite distance, and NaN elsewhere.

    Attributes:
        point: The closest point [world].
        distance: The distance to it [world]; that of :func:`geokit.kernels.signed_distance` is negative inside.
        triangle_id: The triangle that it lies on.
        barycentric: Weights of the triangle's corners there.
    """

    point: wp.vec3d
    distance: wp.float64
    triangle_id: int
    barycentric: wp.vec3d


@wp.func
def closest_in_slot(tree: SurfaceTree, p: wp.vec3d, slot: int) -> ClosestPoint:
    """The closest point of the triangle in a slot; a miss for -1."""
    none = wp.float64(wp.nan)
    found = ClosestPoint()
    found.point = wp.vec3d(none, none, none)
    found.distance = wp.float64(wp.inf)
    found.triangle_id = -1
    found.barycentric = found.point
    if slot >= 0:
        a = tree.corners[3 * slot]
        b = tree.corners[3 * slot + 1]
        c = tree.corners[3 * slot + 2]
        weights = closest_on_triangle(p, a, b, c)
        found.point = a + weights[1] * (b - a) + weights[2] * (c - a)
        found.distance = wp.length(offset_from_triangle(p, a, b, c, weights))
        found.triangle_id = tree.slot_triangle[slot]
        found.barycentric = weights
    return found


@wp.func
def put_closest(
    i: int,
    p: wp.vec3d,
    tree: SurfaceTree,
    max_distance: wp.float64,
    start: int,
    out_points: wp.array(dtype=wp.vec3d),
    out_distance: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
    out_nonfinite: wp.array(dtype=int),
) -> int:
    """Answer query ``i``, from the slot of a near one on; returns its slot, -1 for a miss."""
    slot = start
    if is_measurable(p):
        slot = nearest_slot(tree, p, max_distance * max_distance, slot)
    else:
        slot = int(-1)
        out_nonfinite[0] = 1
    found = closest_in_slot(tree, p, slot)
    out_points[i] = found.point
    out_distance[i] = found.distance
    out_triangle_id[i] = found.triangle_id
    out_barycentric[i] = found.barycentric
    return slot


@wp.kernel(cuda_max_registers=REGISTERS)
def closest_point_kernel(
    first: int,
    group: int,
    order: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    max_distance: wp.float64,
    out_points: wp.array(dtype=wp.vec3d),
    out_distance: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
    out_nonfinite: wp.array(dtype=int),
):
    """One thread answers a group of queries that are near each other: each starts from the previous answer.

    A query that is not finite, or too far away, is a miss and raises ``out_nonfinite``; the host then finds the row.
    """
    begin = (first + wp.tid()) * group
    slot = int(-1)
    for k in range(begin, wp.min(begin + group, points.shape[0])):
        prefetch_query(points, order, k)
        i = order[k]
        slot = put_closest(
            i,
            points[i],
            tree,
            max_distance,
            slot,
            out_points,
            out_distance,
            out_triangle_id,
            out_barycentric,
            out_nonfinite,
        )
