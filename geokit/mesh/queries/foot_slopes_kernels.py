"""Derivatives of closest points with respect to the points that were asked; the formulas are those of gradients.py."""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

# Without fused multiply-adds a GPU gives the same bits as a CPU.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NONE = wp.constant(wp.float64(0.0))


@wp.func
def over_face(
    p: wp.vec3d,
    a: wp.vec3d,
    b: wp.vec3d,
    c: wp.vec3d,
    distance: wp.float64,
    is_signed: bool,
    by_distance: wp.float64,
    by_foot: wp.vec3d,
    by_weights: wp.vec3d,
) -> wp.vec3d:
    """Of a foot within a triangle: it moves along the plane, and the distance is the height over the plane."""
    normal = wp.cross(b - a, c - a)
    area = wp.dot(normal, normal)
    height = wp.dot(p - a, normal)
    side = wp.float64(1.0)
    if height < NONE:
        side = -side
    if distance < NONE:
        side = -side
    # On the surface: the signed distance goes on along the normal, the other one has a kink.
    if is_signed and distance == NONE:
        side = wp.float64(1.0)
    if not is_signed and height == NONE:
        side = NONE
    slope = by_foot - (wp.dot(by_foot, normal) / area) * normal
    slope += ((by_weights[1] - by_weights[0]) / area) * wp.cross(c - a, normal)
    slope += ((by_weights[2] - by_weights[0]) / area) * wp.cross(normal, b - a)
    return slope + (by_distance * side / wp.sqrt(area)) * normal


@wp.func
def over_edge(
    p: wp.vec3d,
    begin: wp.vec3d,
    end: wp.vec3d,
    distance: wp.float64,
    by_distance: wp.float64,
    by_foot: wp.vec3d,
    by_share: wp.float64,
) -> wp.vec3d:
    """Of a foot on an edge, along which it moves, or on a vertex, which is an edge without length."""
    edge = end - begin
    squared = wp.dot(edge, edge)
    slope = wp.vec3d()
    foot = begin
    if squared > NONE:
        foot = begin + (wp.dot(p - begin, edge) / squared) * edge
        slope = ((wp.dot(by_foot, edge) + by_share) / squared) * edge
    away = p - foot
    length = wp.length(away)
    if length > NONE:
        if distance < NONE:
            length = -length
        slope += (by_distance / length) * away
    return slope


@wp.func
def foot_slope(
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    triangle: int,
    p: wp.vec3d,
    weights: wp.vec3d,
    distance: wp.float64,
    is_signed: bool,
    by_distance: wp.float64,
    by_foot: wp.vec3d,
    by_weights: wp.vec3d,
) -> wp.vec3d:
    """The slope of a point, from those of its answer."""
    a = vertices[faces[3 * triangle]]
    b = vertices[faces[3 * triangle + 1]]
    c = vertices[faces[3 * triangle + 2]]
    has_a = weights[0] > NONE
    has_b = weights[1] > NONE
    has_c = weights[2] > NONE
    if has_a and has_b and has_c and wp.length_sq(wp.cross(b - a, c - a)) > NONE:
        return over_face(p, a, b, c, distance, is_signed, by_distance, by_foot, by_weights)
    # From the first corner with weight to the last.
    begin = c
    by_begin = by_weights[2]
    if has_a:
        begin = a
        by_begin = by_weights[0]
    elif has_b:
        begin = b
        by_begin = by_weights[1]
    end = a
    by_end = by_weights[0]
    if has_c:
        end = c
        by_end = by_weights[2]
    elif has_b:
        end = b
        by_end = by_weights[1]
    return over_edge(p, begin, end, distance, by_distance, by_foot, by_end - by_begin)


@wp.kernel
def foot_slopes_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    is_signed: bool,
    points: wp.array(dtype=Any),
    distance: wp.array(dtype=Any),
    triangle_id: wp.array(dtype=int),
    barycentric: wp.array(dtype=Any),
    by_distance: wp.array(dtype=Any),
    by_foot: wp.array(dtype=Any),
    by_weights: wp.array(dtype=Any),
    out_slopes: wp.array(dtype=Any),
):
    """Add to the slopes of the points what those of their answers come to; a miss adds nothing."""
    i = first + wp.tid()
    triangle = triangle_id[i]
    if triangle < 0:
        return
    p = wp.vec3d(points[i])
    weights = wp.vec3d(barycentric[i])
    d = wp.float64(distance[i])
    slope_d = wp.float64(by_distance[i])
    slope_f = wp.vec3d(by_foot[i])
    slope_w = wp.vec3d(by_weights[i])
    slope = foot_slope(vertices, faces, triangle, p, weights, d, is_signed, slope_d, slope_f, slope_w)
    out_slopes[i] = out_slopes[i] + type(points[i])(slope)


@wp.kernel
def distance_slopes_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    is_signed: bool,
    shortest: wp.float64,
    points: wp.array(dtype=Any),
    distance: wp.array(dtype=Any),
    feet: wp.array(dtype=Any),
    triangle_id: wp.array(dtype=int),
    barycentric: wp.array(dtype=Any),
    by_distance: wp.array(dtype=Any),
    out_slopes: wp.array(dtype=Any),
):
    """The slopes of the points from those of their distances alone; 0 for a miss.

    A distance above ``shortest`` has the direction between the point and its foot, without a look at the triangle.
    """
    i = first + wp.tid()
    slope = wp.vec3d()
    triangle = triangle_id[i]
    if triangle >= 0:
        p = wp.vec3d(points[i])
        d = wp.float64(distance[i])
        slope_d = wp.float64(by_distance[i])
        if wp.abs(d) > shortest:
            slope = (slope_d / d) * (p - wp.vec3d(feet[i]))
        else:
            weights = wp.vec3d(barycentric[i])
            slope = foot_slope(vertices, faces, triangle, p, weights, d, is_signed, slope_d, wp.vec3d(), wp.vec3d())
    out_slopes[i] = type(points[i])(slope)


_PRECISIONS = ((wp.float32, wp.vec3f), (wp.float64, wp.vec3d))


def _overloads(kernel: Any, vectors: tuple[str, ...]) -> dict[Any, Any]:
    """Overloads of a kernel by the type of the points' coordinates."""
    return {
        number: wp.overload(
            kernel,
            {name: wp.array(dtype=vector) for name in vectors}
            | {name: wp.array(dtype=number) for name in ("distance", "by_distance")},
        )
        for number, vector in _PRECISIONS
    }


FOOT_SLOPES = _overloads(foot_slopes_kernel, ("points", "barycentric", "by_foot", "by_weights", "out_slopes"))
DISTANCE_SLOPES = _overloads(distance_slopes_kernel, ("points", "feet", "barycentric", "out_slopes"))
