"""Bounds for the distance of a triangle's points from a surface, and where to cut triangles whose bound is too wide.

The distance from one triangle of the surface is convex over a piece, so it is largest at a corner of the piece. The
distance from the surface is at most the distance from any of its triangles. So the largest distance of a piece is known
exactly if all its corners have the same closest triangle. If two corners have different ones, the edge between them is
cut at the point equally far from both triangles: each half then has one of them.
"""

# mypy: ignore-errors
import warp as wp

from geokit.mesh.triangle.closest_kernels import closest_on_triangle, offset_from_triangle

# Without fused multiply-adds a GPU gives the same bits as a CPU, and the same cuts.
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Any point of a triangle is within longest edge / sqrt(3) of a corner; the equilateral triangle is the worst case.
# Rounded up.
COVERING_RATIO = wp.constant(wp.float64(0.5773502691896259))
# Steps toward the point equally far from two triangles; most searches end sooner. The point need not be exact: the
# bound is too wide by no more than the difference of the two distances at the cut.
CUT_STEPS = wp.constant(8)
# One of this many successive cuts halves the longest edge, so that pieces shrink whatever the other cuts do.
HALVE_EVERY = wp.constant(4)


@wp.struct
class Target:
    """The triangles of the other surface [world]."""

    vertices: wp.array(dtype=wp.vec3d)
    faces: wp.array(dtype=int)


@wp.func
def distance_from_triangle(target: Target, triangle: wp.int32, p: wp.vec3d) -> wp.float64:
    a = target.vertices[target.faces[3 * triangle]]
    b = target.vertices[target.faces[3 * triangle + 1]]
    c = target.vertices[target.faces[3 * triangle + 2]]
    return wp.length(offset_from_triangle(p, a, b, c, closest_on_triangle(p, a, b, c)))


@wp.func
def longest_edge(corners: wp.array(dtype=wp.vec3d), piece: wp.int32) -> wp.int32:
    """Number of the first corner of the longest edge; edge k runs from corner k to the next one."""
    longest = int(0)
    most = wp.float64(-1.0)
    for k in range(3):
        length = wp.length(corners[3 * piece + (k + 1) % 3] - corners[3 * piece + k])
        if length > most:
            most = length
            longest = k
    return longest


@wp.func
def equally_far(
    target: Target,
    t: wp.int32,
    u: wp.int32,
    p: wp.vec3d,
    q: wp.vec3d,
    gap_p: wp.float64,
    gap_q: wp.float64,
    least_gap: wp.float64,
) -> wp.vec2d:
    """The point between p (nearer to triangle t) and q (nearer to u) that is equally far from both, to ``least_gap``.

    ``gap_p`` and ``gap_q``, not negative, are how much farther the other triangle is at each end. Returns the position
    as a fraction of the way from p to q, and the larger of the two distances there.
    """
    low = wp.float64(0.0)
    high = wp.float64(1.0)
    at_low = gap_p
    at_high = gap_q
    cut = wp.float64(0.5)
    distance = wp.float64(wp.inf)
    for step in range(CUT_STEPS):
        # Every third step bisects: the secant may converge slowly where one of the distances has a kink.
        cut = wp.float64(0.5) * (low + high)
        if step % 3 != 2 and at_low + at_high > wp.float64(0.0):
            cut = low + (high - low) * (at_low / (at_low + at_high))
        x = p + cut * (q - p)
        to_t = distance_from_triangle(target, t, x)
        to_u = distance_from_triangle(target, u, x)
        distance = wp.max(to_t, to_u)
        gap = to_u - to_t
        if wp.abs(gap) <= least_gap:
            break
        if gap > wp.float64(0.0):
            low = cut
            at_low = gap
            at_high = wp.float64(0.5) * at_high
        else:
            high = cut
            at_high = -gap
            at_low = wp.float64(0.5) * at_low
    return wp.vec2d(cut, distance)


@wp.func
def corner_distances(
    corners: wp.array(dtype=wp.vec3d),
    distance: wp.array(dtype=wp.float64),
    triangle: wp.array(dtype=int),
    i: wp.int32,
    target: Target,
) -> wp.mat33d:
    """Matrix whose row k has the distances of corner k of piece i from the closest triangles of the three corners."""
    table = wp.mat33d()
    for k in range(3):
        for j in range(3):
            if triangle[3 * i + j] == triangle[3 * i + k]:
                table[k, j] = distance[3 * i + k]
            else:
                table[k, j] = distance_from_triangle(target, triangle[3 * i + j], corners[3 * i + k])
    return table


@wp.func
def edge_gap(table: wp.mat33d, k: wp.int32) -> wp.float64:
    """How much the closest triangles of edge k's ends differ in distance; 0 if each is as near to the other end."""
    j = (k + 1) % 3
    return wp.min(table[k, j] - table[k, k], table[j, k] - table[j, j])


@wp.func
def straddling_bound(
    corners: wp.array(dtype=wp.vec3d),
    triangle: wp.array(dtype=int),
    i: wp.int32,
    table: wp.mat33d,
    start: wp.int32,
    target: Target,
    enough: wp.float64,
    least_gap: wp.float64,
) -> wp.vec2d:
    """The bound that piece i would have if it were cut between its corners' closest triangles; inf if above ``enough``.

    Each part is a polygon that belongs to one of the triangles, so that the distance is largest at its corners: the
    piece's own corners, a point on each edge between two triangles and, with three triangles, one in the middle.
    Returns the bound, and where the edge ``start`` is cut; that edge is examined first.
    """
    bound = wp.max(table[0, 0], wp.max(table[1, 1], table[2, 2]))
    share = wp.float64(0.5)
    middle = wp.vec3d()
    cuts = int(0)
    for n in range(3):
        k = (start + n) % 3
        j = (k + 1) % 3
        t = triangle[3 * i + k]
        u = triangle[3 * i + j]
        # Once a cut on one edge is too far away, there is no bound.
        if t != u and bound <= enough:
            # Rounding may make the closest triangle slightly farther than another one.
            gap_p = wp.max(table[k, j] - table[k, k], wp.float64(0.0))
            gap_q = wp.max(table[j, k] - table[j, j], wp.float64(0.0))
            p = corners[3 * i + k]
            q = corners[3 * i + j]
            cut = equally_far(target, t, u, p, q, gap_p, gap_q, least_gap)
            bound = wp.max(bound, cut[1])
            middle += p + cut[0] * (q - p)
            cuts += 1
            if n == 0:
                share = cut[0]
    if cuts == 3 and bound <= enough:
        middle = middle / wp.float64(3.0)
        for k in range(3):
            bound = wp.max(bound, distance_from_triangle(target, triangle[3 * i + k], middle))
    if bound > enough:
        bound = wp.float64(wp.inf)
    return wp.vec2d(bound, share)


@wp.kernel
def bound_kernel(
    first: int,
    corners: wp.array(dtype=wp.vec3d),
    distance: wp.array(dtype=wp.float64),
    triangle: wp.array(dtype=int),
    depth: wp.array(dtype=int),
    target: Target,
    enough: wp.float64,
    least_gap: wp.float64,
    out_candidate: wp.array(dtype=int),
    out_upper: wp.array(dtype=wp.float64),
    out_edge: wp.array(dtype=int),
    out_cut: wp.array(dtype=wp.vec3d),
):
    """Lower the bound of a piece, and choose where to cut it if the bound is above ``enough``.

    On input ``out_candidate`` is a triangle of the surface that may be near the whole piece; on output it is the best
    one found. ``out_cut`` lies on edge ``out_edge``: between the two closest triangles that differ most, or at the
    middle of the longest edge.
    """
    i = first + wp.tid()
    table = corner_distances(corners, distance, triangle, i, target)
    edge = longest_edge(corners, i)
    length = wp.length(corners[3 * i + (edge + 1) % 3] - corners[3 * i + edge])
    furthest = wp.max(table[0, 0], wp.max(table[1, 1], table[2, 2]))
    upper = wp.min(out_upper[i], furthest + COVERING_RATIO * length)
    best = out_candidate[i]
    for j in range(3):
        bound = wp.max(table[0, j], wp.max(table[1, j], table[2, j]))
        if bound < upper:
            upper = bound
            best = triangle[3 * i + j]
    inherited = out_candidate[i]
    bound = furthest
    for k in range(3):
        if bound < upper:
            bound = wp.max(bound, distance_from_triangle(target, inherited, corners[3 * i + k]))
    if bound < upper:
        upper = bound
        best = inherited
    share = wp.float64(0.5)
    if upper > enough:
        start = int(0)
        most = edge_gap(table, 0)
        for k in range(1, 3):
            if edge_gap(table, k) > most:
                most = edge_gap(table, k)
                start = k
        straddling = straddling_bound(corners, triangle, i, table, start, target, enough, least_gap)
        upper = wp.min(upper, straddling[0])
        if most > least_gap and depth[i] % HALVE_EVERY != HALVE_EVERY - 1:
            edge = start
            share = straddling[1]
    p = corners[3 * i + edge]
    q = corners[3 * i + (edge + 1) % 3]
    out_candidate[i] = best
    out_upper[i] = upper
    out_edge[i] = edge
    out_cut[i] = p + share * (q - p)
