"""Steps of iterative closest points: moved points, their partners, and the sums that a step is solved from.

Sums go over runs of points and are added up in the order of the runs: equal bits for any number of threads, on any
device. Coordinates are taken relative to a centre near the points, so that far from the origin nothing is lost.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Points that one item sums up, and the numbers it gives.
SUM_RUN = wp.constant(256)
# Pairs, squared distances, 21 products of the six columns, six with the residual.
PLANE_SUMS = wp.constant(29)
# Pairs, squared distances, two sums of positions, nine products.
POINT_SUMS = wp.constant(17)


@wp.kernel
def order_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    order: wp.array(dtype=wp.int32),
    out_points: wp.array(dtype=wp.vec3d),
):
    i = first + wp.tid()
    out_points[i] = points[order[i]]


@wp.kernel
def move_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    rotation: wp.mat33d,
    centre: wp.vec3d,
    place: wp.vec3d,
    out_points: wp.array(dtype=wp.vec3d),
):
    """Points turned about ``centre``, which comes to ``place``."""
    i = first + wp.tid()
    out_points[i] = rotation * (points[i] - centre) + place


@wp.kernel
def unit_kernel(first: int, normals: wp.array(dtype=wp.vec3d), out_normals: wp.array(dtype=wp.vec3d)):
    """Vectors of length 1; zeros stay zero, and their planes take no part."""
    i = first + wp.tid()
    n = normals[i]
    # Of about unit size before they are squared.
    largest = wp.max(wp.max(wp.abs(n[0]), wp.abs(n[1])), wp.abs(n[2]))
    unit = wp.vec3d()
    if largest > wp.float64(0.0):
        n = n / largest
        unit = n / wp.sqrt((n[0] * n[0] + n[1] * n[1]) + n[2] * n[2])
    out_normals[i] = unit


@wp.kernel
def limit_kernel(
    first: int,
    moved: wp.array(dtype=wp.vec3d),
    points: wp.array(dtype=wp.vec3d),
    partner: wp.array(dtype=wp.int32),
    most: wp.float64,
    out_limit: wp.array(dtype=wp.float64),
):
    """Squared distance of each point from a target's point that was its partner, or ``most`` if that is less.

    Rounded as the search rounds it: the limit does not leave that partner out.
    """
    i = first + wp.tid()
    limit = most
    j = partner[i]
    if j >= 0:
        d = points[j] - moved[i]
        limit = wp.min(limit, (d[0] * d[0] + d[1] * d[1]) + d[2] * d[2])
    out_limit[i] = limit


@wp.kernel
def cloud_partner_kernel(
    first: int,
    index: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3d),
    normals: wp.array(dtype=wp.vec3d),
    out_partner: wp.array(dtype=wp.vec3d),
    out_normal: wp.array(dtype=wp.vec3d),
    out_paired: wp.array(dtype=wp.int32),
):
    """The point of the target that was found for each point, if any; its normal, if there are any."""
    i = first + wp.tid()
    j = index[i]
    paired = wp.int32(0)
    if j >= 0:
        paired = wp.int32(1)
        out_partner[i] = points[j]
        if normals.shape[0] > 0:
            out_normal[i] = normals[j]
    out_paired[i] = paired


@wp.kernel
def surface_partner_kernel(
    first: int,
    closest: wp.array(dtype=wp.vec3d),
    triangle_id: wp.array(dtype=wp.int32),
    normals: wp.array(dtype=wp.vec3d),
    out_partner: wp.array(dtype=wp.vec3d),
    out_normal: wp.array(dtype=wp.vec3d),
    out_paired: wp.array(dtype=wp.int32),
):
    """The closest point of a surface, and its triangle's normal."""
    i = first + wp.tid()
    t = triangle_id[i]
    paired = wp.int32(0)
    if t >= 0:
        paired = wp.int32(1)
        out_partner[i] = closest[i]
        out_normal[i] = normals[t]
    out_paired[i] = paired


@wp.kernel
def volume_partner_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    distance: wp.array(dtype=wp.float64),
    gradient: wp.array(dtype=wp.vec3d),
    limit: wp.float64,
    out_partner: wp.array(dtype=wp.vec3d),
    out_normal: wp.array(dtype=wp.vec3d),
    out_paired: wp.array(dtype=wp.int32),
):
    """Down a distance field's gradient to its zero level; where it has none there is no partner."""
    i = first + wp.tid()
    g = gradient[i]
    length = wp.sqrt((g[0] * g[0] + g[1] * g[1]) + g[2] * g[2])
    paired = wp.int32(0)
    if wp.abs(distance[i]) <= limit and length > wp.float64(0.0):
        paired = wp.int32(1)
        normal = g / length
        out_partner[i] = points[i] - normal * distance[i]
        out_normal[i] = normal
    out_paired[i] = paired


@wp.kernel
def plane_sums_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    partner: wp.array(dtype=wp.vec3d),
    normal: wp.array(dtype=wp.vec3d),
    paired: wp.array(dtype=wp.int32),
    centre: wp.vec3d,
    inverse_size: wp.float64,
    out_sums: wp.array(dtype=wp.float64, ndim=2),
):
    """Normal equations of the distances from the partners' planes under a small turn about ``centre`` and a shift.

    A pair's row is ``((p - centre) / size x n, n)``: the turn is counted by how far it moves what is a size away, so
    that all six unknowns are lengths.
    """
    run = first + wp.tid()
    count = wp.float64(0.0)
    squares = wp.float64(0.0)
    product = wp.matrix(shape=(6, 6), dtype=wp.float64)
    right = wp.vector(length=6, dtype=wp.float64)
    for i in range(run * SUM_RUN, wp.min((run + 1) * SUM_RUN, points.shape[0])):
        if paired[i] == 1:
            n = normal[i]
            d = points[i] - partner[i]
            c = wp.cross((points[i] - centre) * inverse_size, n)
            row = wp.vector(c[0], c[1], c[2], n[0], n[1], n[2])
            count += wp.float64(1.0)
            squares += (d[0] * d[0] + d[1] * d[1]) + d[2] * d[2]
            product += wp.outer(row, row)
            right += row * ((n[0] * d[0] + n[1] * d[1]) + n[2] * d[2])
    out_sums[run, 0] = count
    out_sums[run, 1] = squares
    at = wp.int32(2)
    for a in range(6):
        for b in range(a, 6):
            out_sums[run, at] = product[a, b]
            at += 1
    for a in range(6):
        out_sums[run, at] = right[a]
        at += 1


@wp.kernel
def point_sums_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    partner: wp.array(dtype=wp.vec3d),
    paired: wp.array(dtype=wp.int32),
    centre: wp.vec3d,
    out_sums: wp.array(dtype=wp.float64, ndim=2),
):
    """Sums of the pairs' positions relative to ``centre`` and of their products."""
    run = first + wp.tid()
    count = wp.float64(0.0)
    squares = wp.float64(0.0)
    total = wp.vec3d()
    partners = wp.vec3d()
    product = wp.mat33d()
    for i in range(run * SUM_RUN, wp.min((run + 1) * SUM_RUN, points.shape[0])):
        if paired[i] == 1:
            p = points[i] - centre
            q = partner[i] - centre
            d = points[i] - partner[i]
            count += wp.float64(1.0)
            squares += (d[0] * d[0] + d[1] * d[1]) + d[2] * d[2]
            total += p
            partners += q
            product += wp.outer(p, q)
    out_sums[run, 0] = count
    out_sums[run, 1] = squares
    for a in range(3):
        out_sums[run, 2 + a] = total[a]
        out_sums[run, 5 + a] = partners[a]
        for b in range(3):
            out_sums[run, 8 + 3 * a + b] = product[a, b]
