"""Derivatives of winding numbers by points and by the vertices of border edges; the formulas are in gradients.py."""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core.gradients.sums_kernels import overloads

# Without fused multiply-adds a GPU gives the same bits as a CPU.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def end_slopes(a: wp.vec3d, b: wp.vec3d):
    """4 pi times the slopes of the ends of an edge that is passed once; the point is at the origin."""
    # That of b and a; of a point far away both are nearly equal.
    normal = wp.cross(b - a, a)
    square = wp.dot(normal, normal)
    la = wp.length(a)
    lb = wp.length(b)
    along = wp.dot(a, b)
    share = wp.float64(0.0)
    by_a = wp.vec3d()
    by_b = wp.vec3d()
    if square > wp.float64(0.0):
        if along < wp.float64(0.0):
            share = (la * lb - along) / square
        else:
            share = wp.float64(1.0) / (la * lb + along)
        by_a = (share / la) * normal
        by_b = (share / lb) * normal
    return by_a, by_b


@wp.kernel
def point_slopes_kernel(
    first: int,
    points: wp.array(dtype=Any),
    vertices: wp.array(dtype=wp.vec3d),
    edges: wp.array(dtype=wp.vec2i),
    passes: wp.array(dtype=wp.float64),
    by_winding: wp.array(dtype=Any),
    out_points: wp.array(dtype=Any),
):
    """The slopes of points, from those of their winding numbers."""
    i = first + wp.tid()
    p = wp.vec3d(points[i])
    total = wp.vec3d()
    for edge in range(edges.shape[0]):
        by_a, by_b = end_slopes(vertices[edges[edge][0]] - p, vertices[edges[edge][1]] - p)
        total -= passes[edge] * (by_a + by_b)
    out_points[i] = type(points[i])(wp.float64(by_winding[i]) * total)


@wp.kernel
def vertex_slopes_kernel(
    first: int,
    parts: int,
    points: wp.array(dtype=Any),
    vertices: wp.array(dtype=wp.vec3d),
    edges: wp.array(dtype=wp.vec2i),
    passes: wp.array(dtype=wp.float64),
    by_winding: wp.array(dtype=Any),
    out_ends: wp.array(dtype=wp.vec3d),
    out_vertex: wp.array(dtype=int),
):
    """The slopes of both ends of an edge, summed over every ``parts``-th point, with the numbers of the vertices."""
    k = first + wp.tid()
    ends = edges[k // parts]
    total_a = wp.vec3d()
    total_b = wp.vec3d()
    for i in range(k % parts, points.shape[0], parts):
        p = wp.vec3d(points[i])
        by_a, by_b = end_slopes(vertices[ends[0]] - p, vertices[ends[1]] - p)
        slope = passes[k // parts] * wp.float64(by_winding[i])
        total_a += slope * by_a
        total_b += slope * by_b
    out_ends[2 * k] = total_a
    out_ends[2 * k + 1] = total_b
    out_vertex[2 * k] = ends[0]
    out_vertex[2 * k + 1] = ends[1]


# By the type of the points' coordinates.
POINT_SLOPES = overloads(point_slopes_kernel, ("points", "out_points"), ("by_winding",))
VERTEX_SLOPES = overloads(vertex_slopes_kernel, ("points",), ("by_winding",))
