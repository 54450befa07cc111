"""Signs of distances: by the pseudonormal at the closest point, by winding numbers, by votes of rays."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def unit_normal(
    vertices: wp.array(dtype=wp.vec3d), faces: wp.array(dtype=int), flipped: wp.array(dtype=wp.bool), triangle: int
) -> wp.vec3d:
    a = vertices[faces[3 * triangle]]
    ab = vertices[faces[3 * triangle + 1]] - a
    ac = vertices[faces[3 * triangle + 2]] - a
    # At unit size: products of small edges would underflow.
    size = wp.max(wp.length(ab), wp.length(ac))
    normal = wp.normalize(wp.cross(ab / size, ac / size))
    if flipped[triangle]:
        normal = -normal
    return normal


@wp.func
def pseudonormal(
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    flipped: wp.array(dtype=wp.bool),
    across: wp.array(dtype=int),
    corner_normal: wp.array(dtype=int),
    vertex_normals: wp.array(dtype=wp.vec3d),
    triangle: int,
    barycentric: wp.vec3d,
) -> wp.vec3d:
    """Angle-weighted normal of the face, edge or vertex of ``triangle`` that the point lies on, of any length."""
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
        return vertex_normals[corner_normal[3 * triangle + largest]]
    normal = unit_normal(vertices, faces, flipped, triangle)
    if zeros == 1:
        # The edge opposite the corner whose weight is zero begins at the next corner.
        beyond = across[3 * triangle + (last_zero + 1) % 3]
        if beyond >= 0:
            normal += unit_normal(vertices, faces, flipped, beyond)
    return normal


@wp.kernel
def pseudonormal_sign_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    closest: wp.array(dtype=wp.vec3d),
    triangle_id: wp.array(dtype=int),
    barycentric: wp.array(dtype=wp.vec3d),
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    flipped: wp.array(dtype=wp.bool),
    across: wp.array(dtype=int),
    corner_normal: wp.array(dtype=int),
    vertex_normals: wp.array(dtype=wp.vec3d),
    out_distance: wp.array(dtype=wp.float64),
):
    """Turns the distance of inside points negative, in place; misses stay."""
    i = first + wp.tid()
    triangle = triangle_id[i]
    if triangle >= 0:
        normal = pseudonormal(vertices, faces, flipped, across, corner_normal, vertex_normals, triangle, barycentric[i])
        if wp.dot(points[i] - closest[i], normal) < wp.float64(0.0):
            out_distance[i] = -out_distance[i]


@wp.kernel
def missed_sign_kernel(
    first: int,
    winding: wp.array(dtype=wp.float64),
    triangle_id: wp.array(dtype=int),
    out_distance: wp.array(dtype=wp.float64),
):
    """Turns the distance negative of points that found no triangle and have a winding number above 1/2, in place."""
    i = first + wp.tid()
    if triangle_id[i] < 0 and winding[i] > wp.float64(0.5):
        out_distance[i] = -out_distance[i]


@wp.kernel
def vote_kernel(first: int, crossings: wp.array(dtype=int), out_votes: wp.array(dtype=int)):
    """Adds a vote for inside where a ray crosses the surface an odd number of times."""
    i = first + wp.tid()
    out_votes[i] = out_votes[i] + (crossings[i] & 1)


@wp.kernel
def parity_sign_kernel(first: int, votes: wp.array(dtype=int), needed: int, out_distance: wp.array(dtype=wp.float64)):
    i = first + wp.tid()
    if votes[i] >= needed:
        out_distance[i] = -out_distance[i]


@wp.kernel
def is_negative_kernel(first: int, distance: wp.array(dtype=wp.float64), out_inside: wp.array(dtype=wp.bool)):
    i = first + wp.tid()
    out_inside[i] = distance[i] < wp.float64(0.0)


@wp.kernel
def confidence_kernel(first: int, winding: wp.array(dtype=wp.float64), out_confidence: wp.array(dtype=wp.float64)):
    i = first + wp.tid()
    out_confidence[i] = wp.abs(winding[i] - wp.float64(0.5))


@wp.kernel
def missed_kernel(first: int, triangle_id: wp.array(dtype=int), out_any: wp.array(dtype=int)):
    i = first + wp.tid()
    if triangle_id[i] < 0:
        out_any[0] = 1
