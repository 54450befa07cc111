"""Angle-weighted vertex normals, and signs of distances by the normal at the closest point."""

# mypy: ignore-errors
import warp as wp

from geokit.core.scan_kernels import part_of

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})


@wp.struct
class Pseudonormals:
    """Pseudonormal tables of a surface."""

    vertices: wp.array(dtype=wp.vec3d)
    faces: wp.array(dtype=int)
    # Triangles whose winding counts as reversed.
    flipped: wp.array(dtype=wp.bool)
    # The triangle across each half-edge; -1 if there is none, or more than one.
    across: wp.array(dtype=int)
    # Index of each corner's vertex normal.
    corner_normal: wp.array(dtype=int)
    # Angle-weighted normals, one for each position.
    vertex_normals: wp.array(dtype=wp.vec3d)


@wp.func
def unit_normal(
    vertices: wp.array(dtype=wp.vec3d), faces: wp.array(dtype=int), flipped: wp.array(dtype=wp.bool), triangle: int
) -> wp.vec3d:
    a = vertices[faces[3 * triangle]]
    ab = vertices[faces[3 * triangle + 1]] - a
    ac = vertices[faces[3 * triangle + 2]] - a
    # At unit size, because products of small edges would underflow.
    size = wp.max(wp.length(ab), wp.length(ac))
    normal = wp.normalize(wp.cross(ab / size, ac / size))
    if flipped[triangle]:
        normal = -normal
    return normal


@wp.kernel
def corner_normals_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    flipped: wp.array(dtype=wp.bool),
    out_normals: wp.array(dtype=wp.vec3d),
):
    """For each corner its triangle's unit normal times the corner's angle; zero without area or angle."""
    triangle = first + wp.tid()
    normal = unit_normal(vertices, faces, flipped, triangle)
    # False for NaN, which a triangle without area gives.
    usable = wp.dot(normal, normal) > wp.float64(0.0)
    for k in range(3):
        a = vertices[faces[3 * triangle + k]]
        towards = vertices[faces[3 * triangle + (k + 1) % 3]] - a
        back = vertices[faces[3 * triangle + (k + 2) % 3]] - a
        # At unit size, because products of small edges would underflow.
        towards = towards / wp.max(wp.max(wp.abs(towards[0]), wp.abs(towards[1])), wp.abs(towards[2]))
        back = back / wp.max(wp.max(wp.abs(back[0]), wp.abs(back[1])), wp.abs(back[2]))
        # Computed from sine and cosine, the angle is exact to rounding, for slivers too.
        angle = wp.atan2(wp.length(wp.cross(towards, back)), wp.dot(towards, back))
        weighted = wp.vec3d()
        if usable and angle > wp.float64(0.0):
            weighted = angle * normal
        out_normals[3 * triangle + k] = weighted


@wp.func
def pseudonormal(tables: Pseudonormals, triangle: int, barycentric: wp.vec3d) -> wp.vec3d:
    """Angle-weighted normal, not normalized, of the face, edge or vertex of ``triangle`` that contains the point."""
    zero = wp.float64(0.0)
    zeros = int(0)
    last_zero = int(0)
    largest = int(0)
    for k in range(3):
        if barycentric[k] == zero:
            zeros += 1
            last_zero = k
        if barycentric[k] > barycentric[largest]:
            largest = k
    if zeros == 2:
        return tables.vertex_normals[tables.corner_normal[3 * triangle + largest]]
    normal = unit_normal(tables.vertices, tables.faces, tables.flipped, triangle)
    if zeros == 1:
        # The edge opposite the corner with weight zero begins at the next corner.
        beyond = tables.across[3 * triangle + (last_zero + 1) % 3]
        if beyond >= 0:
            normal += unit_normal(tables.vertices, tables.faces, tables.flipped, beyond)
    return normal


@wp.func
def is_behind(tables: Pseudonormals, p: wp.vec3d, foot: wp.vec3d, triangle: int, barycentric: wp.vec3d) -> bool:
    """Whether p lies behind its closest point, as the normals show there."""
    return wp.dot(p - foot, pseudonormal(tables, triangle, barycentric)) < wp.float64(0.0)


@wp.kernel
def pseudonormal_sign_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    closest: wp.array(dtype=wp.vec3d),
    triangle_id: wp.array(dtype=int),
    barycentric: wp.array(dtype=wp.vec3d),
    tables: Pseudonormals,
    outside: wp.float64,
    out_distance: wp.array(dtype=wp.float64),
):
    """Negate the distances of inside points in place; misses, and points beyond ``outside``, stay unchanged."""
    i = first + wp.tid()
    triangle = triangle_id[i]
    if triangle >= 0 and out_distance[i] < outside:
        if is_behind(tables, points[i], closest[i], triangle, barycentric[i]):
            out_distance[i] = -out_distance[i]


@wp.kernel
def forest_pseudonormal_kernel(
    first: int,
    offsets: wp.array(dtype=int),
    asked: wp.array(dtype=wp.bool),
    points: wp.array(dtype=wp.vec3d),
    closest: wp.array(dtype=wp.vec3d),
    triangle_id: wp.array(dtype=int),
    barycentric: wp.array(dtype=wp.vec3d),
    tables: wp.array(dtype=Pseudonormals),
    outside: wp.array(dtype=wp.float64),
    out_distance: wp.array(dtype=wp.float64),
):
    """As pseudonormal_sign_kernel; mesh m has the queries from ``offsets[m]`` on."""
    i = first + wp.tid()
    mesh = part_of(offsets, i)
    if asked[mesh]:
        triangle = triangle_id[i]
        if triangle >= 0 and out_distance[i] < outside[mesh]:
            normal = pseudonormal(tables[mesh], triangle, barycentric[i])
            if wp.dot(points[i] - closest[i], normal) < wp.float64(0.0):
                out_distance[i] = -out_distance[i]
