"""Derivatives of closest points by the points that were asked and by the corners; the formulas are in gradients.py."""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core.gradients.sums_kernels import overloads

# Without fused multiply-adds a GPU gives the same bits as a CPU.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Within this share of the mesh's size a distance is too short for the direction between its ends, and its sign may be
# wrong: coordinates of float32, and winding numbers on a GPU, are rounded to a tenth of it.
SHORT = 2.0**-20
# Share of the largest coordinate up to which a distance is noise: points on bracket.obj, which has slivers, are off by
# up to 150 roundings, and this is 4,096.
ROUNDING = 2.0**-40
NONE = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))


@wp.struct
class SlopedFaces:
    """Faces of one mesh or of many."""

    vertices: wp.array(dtype=wp.vec3d)
    faces: wp.array(dtype=int)
    # Where the winding shows outward, see Surface._outward; without rows for distances without signs.
    outward: wp.array(dtype=int)
    # Size of the one mesh; first face and size of each of many.
    scale: wp.float64
    begins: wp.array(dtype=int)
    scales: wp.array(dtype=wp.float64)


@wp.struct
class Corners:
    """The corners of a triangle, or their slopes."""

    a: wp.vec3d
    b: wp.vec3d
    c: wp.vec3d


@wp.func
def face_of(mesh: SlopedFaces, owner: wp.array(dtype=int), row: int, face: int) -> int:
    """The number of a row's face among all; ``owner`` has the mesh that each row asks, or no rows if there is one."""
    if owner.shape[0] > 0:
        return mesh.begins[owner[row]] + face
    return face


@wp.func
def scale_of(mesh: SlopedFaces, owner: wp.array(dtype=int), row: int) -> wp.float64:
    """The size of the mesh that a row asks."""
    if owner.shape[0] > 0:
        return mesh.scales[owner[row]]
    return mesh.scale


@wp.func
def corners_of(mesh: SlopedFaces, face: int) -> Corners:
    found = Corners()
    found.a = mesh.vertices[mesh.faces[3 * face]]
    found.b = mesh.vertices[mesh.faces[3 * face + 1]]
    found.c = mesh.vertices[mesh.faces[3 * face + 2]]
    return found


@wp.func
def shared(weights: wp.vec3d, slope: wp.vec3d) -> Corners:
    """The slopes of corners whose weighted sum has a slope."""
    found = Corners()
    found.a = weights[0] * slope
    found.b = weights[1] * slope
    found.c = weights[2] * slope
    return found


@wp.func
def give(
    mesh: SlopedFaces,
    face: int,
    slopes: Corners,
    row: int,
    out_corners: wp.array(dtype=wp.vec3d),
    out_vertex: wp.array(dtype=int),
):
    """Write the slopes of a row's corners, and the vertices that these are."""
    out_corners[3 * row] = slopes.a
    out_corners[3 * row + 1] = slopes.b
    out_corners[3 * row + 2] = slopes.c
    for corner in range(3):
        vertex = int(0)
        if face >= 0:
            vertex = mesh.faces[3 * face + corner]
        out_vertex[3 * row + corner] = vertex


@wp.func
def give(  # noqa: F811
    mesh: SlopedFaces,
    face: int,
    slopes: Corners,
    row: int,
    out_corners: wp.array(dtype=int),
    out_vertex: wp.array(dtype=int),
):
    """Where corners are not wanted: compilers then leave out what computes them."""
    return


@wp.func
def rounding(p: wp.vec3d, scale: wp.float64) -> wp.float64:
    """The distance within which the direction from a foot is noise."""
    return wp.float64(ROUNDING) * (wp.abs(p[0]) + wp.abs(p[1]) + wp.abs(p[2]) + scale)


@wp.func
def over_face(
    on: Corners, p: wp.vec3d, weights: wp.vec3d, normal: wp.vec3d, area: wp.float64, by: wp.vec3d, by_weights: wp.vec3d
):
    """Slopes of a point and of the corners, from those of its foot within a triangle and of the foot's weights."""
    # Rows that give the second and third weight of a point.
    second = wp.cross(on.c - on.a, normal) / area
    third = wp.cross(normal, on.b - on.a) / area
    slope = by - (wp.dot(by, normal) / area) * normal
    slope += (by_weights[1] - by_weights[0]) * second + (by_weights[2] - by_weights[0]) * third
    height = (wp.dot(p - on.a, normal) / area) * normal
    slopes = shared(weights, by - slope)
    along_second = wp.dot(slope, second)
    along_third = wp.dot(slope, third)
    slopes.a -= (along_second + along_third) * height
    slopes.b += along_second * height
    slopes.c += along_third * height
    return slope, slopes


@wp.func
def over_edge(
    p: wp.vec3d,
    begin: wp.vec3d,
    end: wp.vec3d,
    distance: wp.float64,
    by_distance: wp.float64,
    by: wp.vec3d,
    by_share: wp.float64,
):
    """Slopes of a point, of the begin and of the end, from those of its foot on the edge and of the end's weight.

    A vertex is an edge without length.
    """
    edge = end - begin
    squared = wp.dot(edge, edge)
    slope = wp.vec3d()
    share = NONE
    turn = NONE
    if squared > NONE:
        share = wp.dot(p - begin, edge) / squared
        turn = (wp.dot(by, edge) + by_share) / squared
        slope = turn * edge
    away = p - (begin + share * edge)
    length = wp.length(away)
    straight = wp.vec3d()
    if length > NONE:
        if distance < NONE:
            length = -length
        straight = (by_distance / length) * away
    moved = by - slope - straight
    return slope + straight, (ONE - share) * moved - turn * away, share * moved + turn * away


@wp.func
def foot_slopes(
    mesh: SlopedFaces,
    on: Corners,
    scale: wp.float64,
    is_signed: bool,
    face: int,
    p: wp.vec3d,
    weights: wp.vec3d,
    distance: wp.float64,
    by_distance: wp.float64,
    by_foot: wp.vec3d,
    by_weights: wp.vec3d,
):
    """The slopes of a point and of the corners of its triangle, from those of its answer."""
    has_a = weights[0] > NONE
    has_b = weights[1] > NONE
    has_c = weights[2] > NONE
    normal = wp.cross(on.b - on.a, on.c - on.a)
    area = wp.dot(normal, normal)
    height = wp.dot(p - on.a, normal)
    is_face = has_a and has_b and has_c and area > NONE
    # Whether the distance goes on along the normal, and on which side of it; see _sides of gradients.py.
    along = is_face
    side = ONE
    if (height < NONE) != (distance < NONE):
        side = -ONE
    if is_signed:
        noise = rounding(p, scale)
        if wp.abs(distance) <= wp.float64(SHORT) * scale + noise:
            side = wp.float64(mesh.outward[face])
        if wp.abs(distance) <= noise:
            along = True
    else:
        if distance == NONE:
            along = True
        if distance == NONE or height == NONE:
            side = NONE
    slope = wp.vec3d()
    slopes = Corners()
    by_away = by_distance
    if along:
        by_away = NONE
        if area > NONE:
            slope = (by_distance * side / wp.sqrt(area)) * normal
            second = wp.dot(wp.cross(on.c - on.a, normal), p - on.a) / area
            third = wp.dot(wp.cross(normal, on.b - on.a), p - on.a) / area
            slopes = shared(wp.vec3d(ONE - second - third, second, third), -slope)
    if is_face:
        moved, others = over_face(on, p, weights, normal, area, by_foot, by_weights)
        slope += moved
        slopes.a += others.a
        slopes.b += others.b
        slopes.c += others.c
        return slope, slopes
    # From the first corner with weight to the last.
    begin = on.c
    by_begin = by_weights[2]
    if has_a:
        begin = on.a
        by_begin = by_weights[0]
    elif has_b:
        begin = on.b
        by_begin = by_weights[1]
    end = on.a
    by_end = by_weights[0]
    if has_c:
        end = on.c
        by_end = by_weights[2]
    elif has_b:
        end = on.b
        by_end = by_weights[1]
    moved, of_begin, of_end = over_edge(p, begin, end, distance, by_away, by_foot, by_end - by_begin)
    if has_a:
        slopes.a += of_begin
    elif has_b:
        slopes.b += of_begin
    else:
        slopes.c += of_begin
    if has_c:
        slopes.c += of_end
    elif has_b:
        slopes.b += of_end
    else:
        slopes.a += of_end
    return slope + moved, slopes


@wp.kernel
def foot_slopes_kernel(
    first: int,
    mesh: SlopedFaces,
    owner: wp.array(dtype=int),
    is_signed: bool,
    shortest: wp.float64,
    points: wp.array(dtype=Any),
    distance: wp.array(dtype=Any),
    feet: wp.array(dtype=Any),
    triangle_id: wp.array(dtype=int),
    barycentric: wp.array(dtype=Any),
    by_distance: wp.array(dtype=Any),
    by_foot: wp.array(dtype=Any),
    by_weights: wp.array(dtype=Any),
    out_points: wp.array(dtype=Any),
    out_corners: wp.array(dtype=Any),
    out_vertex: wp.array(dtype=int),
):
    """The slopes of points and of the corners that they found, from those of their answers; 0 for a miss.

    Slopes of answers that are 0, and outputs that are not wanted, have no rows. Where distances alone have slopes, one
    above ``shortest`` shares of the mesh's size has the direction between the point and its foot.
    """
    i = first + wp.tid()
    slope = wp.vec3d()
    slopes = Corners()
    face = triangle_id[i]
    if face >= 0:
        scale = scale_of(mesh, owner, i)
        face = face_of(mesh, owner, i, face)
        p = wp.vec3d(points[i])
        weights = wp.vec3d(barycentric[i])
        d = wp.float64(distance[i])
        slope_d = NONE
        slope_f = wp.vec3d()
        slope_w = wp.vec3d()
        if by_distance.shape[0] > 0:
            slope_d = wp.float64(by_distance[i])
        if by_foot.shape[0] > 0:
            slope_f = wp.vec3d(by_foot[i])
        if by_weights.shape[0] > 0:
            slope_w = wp.vec3d(by_weights[i])
        is_alone = by_foot.shape[0] == 0 and by_weights.shape[0] == 0
        if is_alone and wp.abs(d) > shortest * scale + rounding(p, scale):
            slope = (slope_d / d) * (p - wp.vec3d(feet[i]))
            slopes = shared(weights, -slope)
        else:
            on = corners_of(mesh, face)
            slope, slopes = foot_slopes(mesh, on, scale, is_signed, face, p, weights, d, slope_d, slope_f, slope_w)
    if out_points.shape[0] > 0:
        out_points[i] = type(points[i])(slope)
    give(mesh, face, slopes, i, out_corners, out_vertex)


def by_corners(kernel: Any, vectors: tuple[str, ...], numbers: tuple[str, ...]) -> dict[bool, dict[Any, Any]]:
    """Overloads of a kernel by whether corners are wanted, and by the type of the coordinates."""
    return {
        is_cornered: overloads(kernel, vectors, numbers, out_corners=wp.array(dtype=corners))
        for is_cornered, corners in ((False, int), (True, wp.vec3d))
    }


FOOT_SLOPES = by_corners(
    foot_slopes_kernel,
    ("points", "feet", "barycentric", "by_foot", "by_weights", "out_points"),
    ("distance", "by_distance"),
)
