"""Bounds for the distance of a triangle's points from a surface, and where to cut triangles whose bound is too wide.

The distance from one triangle of the surface is convex over a piece, so it is largest at a corner of the piece; and the
distance from the surface is not above the one from any of its triangles. A piece all of whose corners have the same
closest triangle is thus known exactly. Where two corners have different ones, the edge between them is cut where both
are equally far: each half then has one of them.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.mesh.bvh.closest_on_triangle_kernels import closest_on_triangle, offset_from_triangle

# Unfused, a GPU gives the same bits as a CPU, and pieces are cut alike.
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Any point of a triangle is within longest edge / sqrt(3) of a corner, in the worst case, which is the equilateral one.
# Rounded up.
COVERING_RATIO = wp.constant(wp.float64(0.5773502691896259))
# Steps towards the point where two triangles are equally far; most end sooner. It need not be exact: a bound is too
# wide by no more than what the two distances differ by at the cut.
CUT_STEPS = wp.constant(8)
# Of every so many cuts in a row one halves the longest edge, so that pieces shrink whatever the others do.
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
    """Where between p, nearer to triangle t, and q, nearer to u, both are equally far, or differ by under least_gap.

    The gaps are how much farther the other triangle is, and not negative. Returns the place as a share of the way, and
    the larger of the two distances there.
    """
    low = wp.float64(0.0)
    high = wp.float64(1.0)
    at_low = gap_p
    at_high = gap_q
    cut = wp.float64(0.5)
    distance = wp.float64(wp.inf)
    for step in range(CUT_STEPS):
        # Every third step halves: the secant may creep along where one of the distances bends.
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
    """Row k: how far corner k of piece i is from the closest triangles of the three corners."""
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
    """How much the closest triangles of the ends of edge k differ: 0 where each is as near to the other end."""
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
    """What the bound would be if piece i were cut between the closest triangles of its corners; inf if above enough.

    Each part is a polygon that has one of the triangles for itself, so that the distance is largest at its corners:
    the piece's own, a point on each edge between two triangles and, where there are three, one in the middle. Returns
    the bound, and where the edge ``start`` is cut, which is looked at first.
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
        # Where one edge is cut too far away there is no bound to be had.
        if t != u and bound <= enough:
            # Rounding may have the closest triangle a trifle farther than another.
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
    """Lowers the bound of a piece, and says where to cut it if that is above ``enough``.

    ``out_candidate`` goes in as a triangle of the surface that may be near the whole piece, and comes out as the best.
    ``out_cut`` lies on edge ``out_edge``: between the two closest triangles that differ most, or in the middle of the
    longest edge.
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
