"""Steps of iterative closest points: moved points, their partners, and the sums for solving a step.

Sums run over fixed runs of points and are added in the order of the runs: the same bits for any number of threads, on
any device. Coordinates are relative to a center near the points, so that no digits are lost far from the origin.
"""

# mypy: ignore-errors
import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Points summed by one item, and the number of sums.
SUM_RUN = wp.constant(256)
# Number of pairs, squared distances, 21 products of the six columns, six products with the residual.
PLANE_SUMS = wp.constant(29)
# Number of pairs, squared distances, two sums of positions, nine products.
POINT_SUMS = wp.constant(17)
# Points of the target around a moved point, its partner first, from which the uncertainty of its normal is estimated.
AROUND = wp.constant(8)
OTHERS = wp.constant(7)
EACH = wp.constant(wp.float64(1.0 / 7.0))


@wp.kernel
def move_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    rotation: wp.mat33d,
    center: wp.vec3d,
    place: wp.vec3d,
    out_points: wp.array(dtype=wp.vec3d),
):
    """Rotate points about ``center``, which moves to ``place``."""
    i = first + wp.tid()
    out_points[i] = rotation * (points[i] - center) + place


@wp.kernel
def unit_kernel(first: int, normals: wp.array(dtype=wp.vec3d), out_normals: wp.array(dtype=wp.vec3d)):
    """Normalize vectors; zeros stay zero, and their planes take no part."""
    i = first + wp.tid()
    n = normals[i]
    # Scaled to about unit size before squaring.
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
    """Squared distance of each point from its previous partner in the target, or ``most`` if that is less.

    Rounded as in the search: the limit does not exclude that partner.
    """
    i = first + wp.tid()
    limit = most
    j = partner[i]
    if j >= 0:
        d = points[j] - moved[i]
        limit = wp.min(limit, (d[0] * d[0] + d[1] * d[1]) + d[2] * d[2])
    out_limit[i] = limit


@wp.kernel
def partner_kernel(
    first: int,
    index: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3d),
    normals: wp.array(dtype=wp.vec3d),
    are_feet: wp.bool,
    out_partner: wp.array(dtype=wp.vec3d),
    out_normal: wp.array(dtype=wp.vec3d),
    out_paired: wp.array(dtype=wp.int32),
):
    """Position and normal of the target's point or triangle found for each point; a flag says whether there is one.

    ``are_feet``: ``points`` has the closest point on the surface for each point.
    """
    i = first + wp.tid()
    j = index[i]
    paired = wp.int32(0)
    if j >= 0:
        paired = wp.int32(1)
        out_partner[i] = points[wp.where(are_feet, i, j)]
        if normals.shape[0] > 0:
            out_normal[i] = normals[j]
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
    """Point on the zero level of a distance field, reached along the gradient; no partner without a gradient."""
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
    center: wp.vec3d,
    inverse_size: wp.float64,
    out_sums: wp.array(dtype=wp.float64, ndim=2),
):
    """Normal equations for the distances from the partners' planes, under a small rotation about ``center`` and a
    shift.

    The row of a pair is ``((p - center) / size x n, n)``: the rotation is measured by the displacement at distance
    ``size``, so that all six unknowns are lengths.
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
            c = wp.cross((points[i] - center) * inverse_size, n)
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
    center: wp.vec3d,
    out_sums: wp.array(dtype=wp.float64, ndim=2),
):
    """Sums of the pairs' positions relative to ``center`` and of their products."""
    run = first + wp.tid()
    count = wp.float64(0.0)
    squares = wp.float64(0.0)
    total = wp.vec3d()
    partners = wp.vec3d()
    product = wp.mat33d()
    for i in range(run * SUM_RUN, wp.min((run + 1) * SUM_RUN, points.shape[0])):
        if paired[i] == 1:
            p = points[i] - center
            q = partner[i] - center
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


@wp.kernel
def tilt_kernel(
    first: int,
    moved: wp.array(dtype=wp.vec3d),
    points: wp.array(dtype=wp.vec3d),
    normals: wp.array(dtype=wp.vec3d),
    around: wp.array(dtype=wp.int32, ndim=2),
    out_tilt: wp.array(dtype=wp.float64),
):
    """Squared angle by which the partner's normal may differ from the target's normal at the moved point.

    From how the normals around the partner differ from its own: a constant, which is their noise, and a part that grows
    with the squared distance, which is curvature, are fitted by least squares. Normals across an edge are no noise:
    differences beyond twice the median are cut.
    """
    i = first + wp.tid()
    out_tilt[i] = wp.float64(0.0)
    n = normals[around[i, 0]]
    q = points[around[i, 0]]
    if wp.dot(n, n) == wp.float64(0.0):
        return
    squared = wp.vector(length=OTHERS, dtype=wp.float64)
    change = wp.vector(length=OTHERS, dtype=wp.float64)
    ranked = wp.vector(length=OTHERS, dtype=wp.float64)
    for k in range(OTHERS):
        m = normals[around[i, k + 1]]
        d = points[around[i, k + 1]] - q
        squared[k] = wp.dot(d, d)
        # |n - m|^2 of unit vectors of either sign.
        change[k] = wp.max(wp.float64(2.0) - wp.float64(2.0) * wp.abs(wp.dot(n, m)), wp.float64(0.0))
        at = wp.int32(k)
        while at > 0 and ranked[wp.max(at - 1, 0)] > change[k]:
            ranked[at] = ranked[at - 1]
            at -= 1
        ranked[at] = change[k]
    most = wp.float64(2.0) * ranked[OTHERS // 2]
    mean = wp.float64(0.0)
    mean_squared = wp.float64(0.0)
    for k in range(OTHERS):
        change[k] = wp.min(change[k], most)
        mean += EACH * change[k]
        mean_squared += EACH * squared[k]
    if mean_squared == wp.float64(0.0):
        return
    above = wp.float64(0.0)
    below = wp.float64(0.0)
    for k in range(OTHERS):
        apart = squared[k] / mean_squared - wp.float64(1.0)
        above += apart * (change[k] - mean)
        below += apart * apart
    growth = mean
    if below > wp.float64(0.0):
        growth = wp.clamp(above / below, wp.float64(0.0), mean)
    off = moved[i] - q
    out_tilt[i] = (mean - growth) + growth * (wp.dot(off, off) / mean_squared)


@wp.kernel
def tangents_kernel(
    first: int,
    normal: wp.array(dtype=wp.vec3d),
    paired: wp.array(dtype=wp.int32),
    tilt: wp.array(dtype=wp.float64),
    most: wp.float64,
    out_first: wp.array(dtype=wp.vec3d),
    out_second: wp.array(dtype=wp.vec3d),
    out_paired: wp.array(dtype=wp.int32),
):
    """Two directions perpendicular to each normal, as long as its tilt in each of them; no pair if it tilts by more."""
    i = first + wp.tid()
    a = wp.vec3d()
    b = wp.vec3d()
    out_paired[i] = 0
    if paired[i] == 1 and tilt[i] <= most:
        out_paired[i] = 1
        n = normal[i]
        across = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
        if wp.abs(n[0]) > wp.float64(0.6):
            across = wp.vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
        length = wp.sqrt(wp.float64(0.5) * tilt[i])
        a = wp.normalize(wp.cross(n, across))
        b = length * wp.cross(n, a)
        a = length * a
    out_first[i] = a
    out_second[i] = b
