"""Derivatives of closest points with respect to the points that were asked; the formulas are those of gradients.py."""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

# Without fused multiply-adds a GPU gives the same bits as a CPU.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Within this share of the mesh's size a distance is too short for the direction between its ends, and its sign may be
# wrong: coordinates of float32, and winding numbers on a GPU, are rounded to a tenth of it.
SHORT = 2.0**-20
# Share of the largest coordinate up to which a distance is noise: points on bracket.obj, which has slivers, are off by
# up to 150 roundings, and this is 4,096.
ROUNDING = 2.0**-40
NONE = wp.constant(wp.float64(0.0))


@wp.func
def rounding(p: wp.vec3d, scale: wp.float64) -> wp.float64:
    """The distance within which the direction from a foot is noise."""
    return wp.float64(ROUNDING) * (wp.abs(p[0]) + wp.abs(p[1]) + wp.abs(p[2]) + scale)


@wp.func
def over_face(
    a: wp.vec3d,
    b: wp.vec3d,
    c: wp.vec3d,
    normal: wp.vec3d,
    area: wp.float64,
    by_foot: wp.vec3d,
    by_weights: wp.vec3d,
) -> wp.vec3d:
    """Of a foot within a triangle: it moves along the plane."""
    slope = by_foot - (wp.dot(by_foot, normal) / area) * normal
    slope += ((by_weights[1] - by_weights[0]) / area) * wp.cross(c - a, normal)
    return slope + ((by_weights[2] - by_weights[0]) / area) * wp.cross(normal, b - a)


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
    scale: wp.float64,
    is_signed: bool,
    outward: wp.array(dtype=int),
    triangle: int,
    p: wp.vec3d,
    weights: wp.vec3d,
    distance: wp.float64,
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
    normal = wp.cross(b - a, c - a)
    area = wp.dot(normal, normal)
    height = wp.dot(p - a, normal)
    is_face = has_a and has_b and has_c and area > NONE
    # Whether the distance goes on along the normal, and on which side of it; see _sides of gradients.py.
    along = is_face
    side = wp.float64(1.0)
    if (height < NONE) != (distance < NONE):
        side = wp.float64(-1.0)
    if is_signed:
        noise = rounding(p, scale)
        if wp.abs(distance) <= wp.float64(SHORT) * scale + noise:
            side = wp.float64(outward[triangle])
        if wp.abs(distance) <= noise:
            along = True
    else:
        if distance == NONE:
            along = True
        if distance == NONE or height == NONE:
            side = NONE
    slope = wp.vec3d()
    by_away = by_distance
    if along:
        by_away = NONE
        if area > NONE:
            slope = (by_distance * side / wp.sqrt(area)) * normal
    if is_face:
        return slope + over_face(a, b, c, normal, area, by_foot, by_weights)
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
    return slope + over_edge(p, begin, end, distance, by_away, by_foot, by_end - by_begin)


@wp.kernel
def foot_slopes_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    scale: wp.float64,
    is_signed: bool,
    outward: wp.array(dtype=int),
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
    slope = foot_slope(vertices, faces, scale, is_signed, outward, triangle, p, weights, d, slope_d, slope_f, slope_w)
    out_slopes[i] = out_slopes[i] + type(points[i])(slope)


@wp.kernel
def distance_slopes_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    scale: wp.float64,
    is_signed: bool,
    outward: wp.array(dtype=int),
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
        if wp.abs(d) > shortest + rounding(p, scale):
            slope = (slope_d / d) * (p - wp.vec3d(feet[i]))
        else:
            weights = wp.vec3d(barycentric[i])
            none = wp.vec3d()
            slope = foot_slope(vertices, faces, scale, is_signed, outward, triangle, p, weights, d, slope_d, none, none)
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
