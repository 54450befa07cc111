"""Orientation of normals: which edges count, Boruvka's rounds on a union-find with parities, and outward signs.

A link is an ancestor and a parity, ``ancestor << 1 | parity``. The parity says whether a normal and that of its
ancestor have opposite signs along the tree. The tree itself is never stored. Both parts of a link change together, in
one 64-bit store.

An edge is a weight and a number, ``weight << 32 | number``, both of 32 bits: edges compare by weight, and no two are
equal. The number, ``row << bits | column``, is the edge's position in the table of neighbors. Each point has a row of
all its edges, the least first. Edges at the start of the row that have become internal to a component are skipped for
good.

A vote says whether two clusters have the same sign, by the sum of all edges between them: positive if they have. Their
pair is ``low << bits | high`` of their roots. Votes are whole numbers: their sums do not depend on the order.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.core.atomic_kernels import add_to, lower_to

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Larger than every edge and every index.
NONE = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
# Edges shorter than this share of the neighborhood's radius say little about the surface's direction: noise turns them.
# Squared.
SHORT = wp.constant(wp.float64(0.25))
# "Up" is tilted slightly, so that y and then x decide the sign of a surface that is vertical.
UP = wp.constant(wp.vec3d(1.0e-8, 1.0e-4, 1.0))
# The first cap ends at this share of the neighborhood's radius below the lowest point: a level surface has a sign.
BELOW = wp.constant(wp.float64(0.01))
# Caps of a component: the volume above its lowest point, and above heights that are a quarter as far from its highest
# point from one to the next.
CAPS = wp.constant(4)
Caps = wp.types.vector(length=4, dtype=wp.int64)
# A smaller cap has to be clearer by this factor, squared: the highest point may be a tip thinner than the spacing,
# whose normals are wrong together.
SMALLER = wp.constant(wp.float64(6.0))
# Points whose volumes are added before they go to their component's sums.
VOLUME_RUN = wp.constant(64)
# The vote of an edge that is sure. 2^30 edges of 2^24 are 2^54.
SURE = wp.constant(wp.float64(16777216.0))


@wp.func_native("""
    float narrow = (float)weight;
    unsigned bits;
    memcpy(&bits, &narrow, 4);
    return (int64_t)(((uint64_t)bits << 32) | (uint64_t)number);
""")
def edge_of(weight: wp.float64, number: wp.int64) -> wp.int64:
    """An edge from its number and its weight, rounded to non-negative float32, whose bits sort like its value."""
    ...


@wp.func_native("""
    const unsigned bits = (unsigned)((uint64_t)edge >> 32);
    float weight;
    memcpy(&weight, &bits, 4);
    return (double)weight;
""")
def weight_of(edge: wp.int64) -> wp.float64: ...


@cpp.func_native("points/clouds/orientation.inl")
def sort_row(begin: wp.int32, count: wp.int32, values: wp.array(dtype=wp.int64)):
    """Sort ``count`` values from ``begin`` on, in place (Shell 1959, gaps of Tokuda 1992)."""
    ...


@wp.func
def is_zero(n: wp.vec3d) -> wp.bool:
    return n[0] == wp.float64(0.0) and n[1] == wp.float64(0.0) and n[2] == wp.float64(0.0)


@wp.kernel
def start_kernel(
    first: int,
    order: wp.array(dtype=wp.int32),
    normal: wp.array(dtype=wp.vec3d),
    distance: wp.array(dtype=wp.float64, ndim=2),
    out_normal: wp.array(dtype=wp.vec3d),
    out_reach: wp.array(dtype=wp.float64),
    out_link: wp.array(dtype=wp.int64),
):
    """Normals and distances of the farthest neighbors in processing order; each point is its own root."""
    i = first + wp.tid()
    out_normal[i] = normal[order[i]]
    out_reach[i] = distance[order[i], distance.shape[1] - 1]
    out_link[i] = wp.int64(i) << wp.int64(1)


@cpp.func_native("points/clouds/orientation.inl")
def is_mine(neighbor: wp.array(dtype=wp.int32, ndim=2), i: wp.int32, j: wp.int32) -> wp.bool:
    """Whether point i, which has the neighbor j, lists their edge: if both have each other, the lower index does."""
    ...


@wp.func
def agreement(
    i: wp.int32,
    j: wp.int32,
    points: wp.array(dtype=wp.vec3d),
    normal: wp.array(dtype=wp.vec3d),
    reach: wp.array(dtype=wp.float64),
) -> wp.float64:
    """How surely an edge tells whether two normals have the same sign, from 0 to 1; 0 if it does not tell.

    Normals are compared as they are, which is right along a flat surface, and after reflecting one in the plane halfway
    between the points, which is right around a bend of any sharpness. An edge through a thin body lies along its
    normals: there the two contradict each other, and the edge does not tell.
    """
    n = normal[i]
    m = normal[j]
    if is_zero(n) or is_zero(m):
        return wp.float64(0.0)
    direct = wp.dot(n, m)
    reflected = direct
    e = points[j] - points[i]
    h = wp.min(reach[i], reach[j])
    squared = wp.dot(e, e) + SHORT * h * h
    if squared > wp.float64(0.0):
        reflected = direct - wp.float64(2.0) * (wp.dot(e, n) / squared) * wp.dot(e, m)
    if direct * reflected <= wp.float64(0.0):
        return wp.float64(0.0)
    return wp.min(wp.min(wp.abs(direct), wp.abs(reflected)), wp.float64(1.0))


@wp.kernel
def degree_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    normal: wp.array(dtype=wp.vec3d),
    reach: wp.array(dtype=wp.float64),
    neighbor: wp.array(dtype=wp.int32, ndim=2),
    out_degree: wp.array(dtype=wp.int32),
):
    """Number of edges of each point."""
    i = first + wp.tid()
    for k in range(neighbor.shape[1]):
        j = neighbor[i, k]
        if is_mine(neighbor, i, j) and agreement(i, j, points, normal, reach) > wp.float64(0.0):
            add_to(out_degree, i, 1)
            add_to(out_degree, j, 1)


@wp.kernel
def edge_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    normal: wp.array(dtype=wp.vec3d),
    reach: wp.array(dtype=wp.float64),
    neighbor: wp.array(dtype=wp.int32, ndim=2),
    bits: wp.int32,
    out_end: wp.array(dtype=wp.int32),
    out_edge: wp.array(dtype=wp.int64),
):
    """The edges of each point, unordered, from the position in ``out_end`` on, which is advanced to their end."""
    i = first + wp.tid()
    for k in range(neighbor.shape[1]):
        j = neighbor[i, k]
        if is_mine(neighbor, i, j):
            sure = agreement(i, j, points, normal, reach)
            if sure > wp.float64(0.0):
                edge = edge_of(wp.float64(1.0) - sure, (wp.int64(i) << wp.int64(bits)) | wp.int64(k))
                out_edge[add_to(out_end, i, 1)] = edge
                out_edge[add_to(out_end, j, 1)] = edge


@wp.kernel
def sort_kernel(
    first: int,
    begin: wp.array(dtype=wp.int32),
    end: wp.array(dtype=wp.int32),
    out_edge: wp.array(dtype=wp.int64),
):
    """Sort each row in ascending order."""
    i = first + wp.tid()
    sort_row(begin[i], end[i] - begin[i], out_edge)


@wp.func
def across(edge: wp.int64, i: wp.int32, bits: wp.int32, neighbor: wp.array(dtype=wp.int32, ndim=2)) -> wp.int32:
    """The other end of one of i's edges."""
    number = wp.uint32(edge & wp.int64(0xFFFFFFFF))
    owner = wp.int32(number >> wp.uint32(bits))
    slot = wp.int32(number & ((wp.uint32(1) << wp.uint32(bits)) - wp.uint32(1)))
    return owner ^ neighbor[owner, slot] ^ i


@wp.kernel
def best_edge_kernel(
    first: int,
    neighbor: wp.array(dtype=wp.int32, ndim=2),
    bits: wp.int32,
    edge: wp.array(dtype=wp.int64),
    end: wp.array(dtype=wp.int32),
    link: wp.array(dtype=wp.int64),
    out_begin: wp.array(dtype=wp.int32),
    out_best: wp.array(dtype=wp.int64),
):
    """The least edge that leaves each component, at its root; edges inside a component are removed from the rows."""
    i = first + wp.tid()
    at = out_begin[i]
    if at == end[i]:
        return
    own = link[i] >> wp.int64(1)
    leaves = wp.bool(False)
    while at < end[i] and not leaves:
        leaves = (link[across(edge[at], i, bits, neighbor)] >> wp.int64(1)) != own
        if not leaves:
            at += 1
    out_begin[i] = at
    if leaves:
        lower_to(out_best, wp.int32(own), edge[at])


@wp.func
def hook_to(r: int, other: wp.int64, best: wp.array(dtype=wp.int64), parity: wp.int64) -> wp.int64:
    """The link of root r to another; -1 for the lower one of two that choose each other.

    Edges and pairs are strictly ordered: no longer cycles exist.
    """
    if best[wp.int32(other)] == best[r] and wp.int64(r) < other:
        return wp.int64(-1)
    return (other << wp.int64(1)) | (parity & wp.int64(1))


@wp.kernel
def hook_kernel(
    first: int,
    normal: wp.array(dtype=wp.vec3d),
    neighbor: wp.array(dtype=wp.int32, ndim=2),
    bits: wp.int32,
    link: wp.array(dtype=wp.int64),
    best: wp.array(dtype=wp.int64),
    out_hook: wp.array(dtype=wp.int64),
):
    """The link of each root across its best edge; -1 for none."""
    r = first + wp.tid()
    out_hook[r] = wp.int64(-1)
    if best[r] == NONE:
        return
    i = wp.int32(wp.uint32(best[r] & wp.int64(0xFFFFFFFF)) >> wp.uint32(bits))
    j = across(best[r], i, bits, neighbor)
    other = (link[i] ^ link[j]) >> wp.int64(1) ^ wp.int64(r)
    opposite = wp.where(wp.dot(normal[i], normal[j]) < wp.float64(0.0), wp.int64(1), wp.int64(0))
    out_hook[r] = hook_to(r, other, best, link[i] ^ link[j] ^ opposite)


@wp.kernel
def apply_kernel(
    first: int, hook: wp.array(dtype=wp.int64), out_link: wp.array(dtype=wp.int64), out_best: wp.array(dtype=wp.int64)
):
    """Apply the links of the roots."""
    r = first + wp.tid()
    out_best[r] = NONE
    if hook[r] >= wp.int64(0):
        out_link[r] = hook[r]


@wp.kernel
@cpp.native_item("points/clouds/orientation.inl", "flatten")
def flatten_kernel(first: int, out_link: wp.array(dtype=wp.int64)):
    """Points the link of each item directly to its root (path compression)."""


@wp.func
def crosses(
    edge: wp.int64,
    i: wp.int32,
    neighbor: wp.array(dtype=wp.int32, ndim=2),
    bits: wp.int32,
    link: wp.array(dtype=wp.int64),
) -> wp.bool:
    """Whether i owns the edge and it leads to another cluster."""
    owner = wp.int32(wp.uint32(edge & wp.int64(0xFFFFFFFF)) >> wp.uint32(bits))
    return owner == i and (link[across(edge, i, bits, neighbor)] ^ link[i]) > wp.int64(1)


@wp.kernel
def crossing_count_kernel(
    first: int,
    neighbor: wp.array(dtype=wp.int32, ndim=2),
    bits: wp.int32,
    edge: wp.array(dtype=wp.int64),
    begin: wp.array(dtype=wp.int32),
    end: wp.array(dtype=wp.int32),
    link: wp.array(dtype=wp.int64),
    out_count: wp.array(dtype=wp.int32),
):
    """Number of edges to other clusters of each point, each edge at its owner."""
    i = first + wp.tid()
    count = wp.int32(0)
    for at in range(begin[i], end[i]):
        if crosses(edge[at], i, neighbor, bits, link):
            count += 1
    out_count[i] = count


@wp.func
def pair_of(a: wp.int64, b: wp.int64, bits: wp.int32) -> wp.int64:
    """The pair of two links' roots."""
    low = wp.min(a >> wp.int64(1), b >> wp.int64(1))
    return (low << wp.int64(bits)) | wp.max(a >> wp.int64(1), b >> wp.int64(1))


@wp.kernel
def crossing_kernel(
    first: int,
    normal: wp.array(dtype=wp.vec3d),
    neighbor: wp.array(dtype=wp.int32, ndim=2),
    bits: wp.int32,
    edge: wp.array(dtype=wp.int64),
    begin: wp.array(dtype=wp.int32),
    end: wp.array(dtype=wp.int32),
    link: wp.array(dtype=wp.int64),
    offset: wp.array(dtype=wp.int32),
    pair_bits: wp.int32,
    out_pair: wp.array(dtype=wp.int64),
    out_vote: wp.array(dtype=wp.int64),
):
    """Pair and vote of each edge between clusters: the cube of its agreement, so that sure edges outvote the others."""
    i = first + wp.tid()
    slot = offset[i]
    for at in range(begin[i], end[i]):
        if crosses(edge[at], i, neighbor, bits, link):
            j = across(edge[at], i, bits, neighbor)
            sure = wp.float64(1.0) - weight_of(edge[at])
            vote = wp.int64(sure * sure * sure * SURE)
            opposite = wp.dot(normal[i], normal[j]) < wp.float64(0.0)
            if opposite != (((link[i] ^ link[j]) & wp.int64(1)) == wp.int64(1)):
                vote = -vote
            out_pair[slot] = pair_of(link[i], link[j], pair_bits)
            out_vote[slot] = vote
            slot += 1


@wp.kernel
def head_kernel(first: int, pair: wp.array(dtype=wp.int64), bits: wp.int32, out_head: wp.array(dtype=wp.int32)):
    """1 for the first of equal pairs, 0 for others and for what is no pair any more."""
    i = first + wp.tid()
    head = wp.int32(1)
    if pair[i] >> wp.int64(2 * bits) != wp.int64(0):
        head = wp.int32(0)
    elif i > 0:
        if pair[i] == pair[i - 1]:
            head = wp.int32(0)
    out_head[i] = head


@wp.kernel
def sum_kernel(
    first: int,
    pair: wp.array(dtype=wp.int64),
    vote: wp.array(dtype=wp.int64),
    count: wp.int32,
    head: wp.array(dtype=wp.int32),
    place: wp.array(dtype=wp.int32),
    out_pair: wp.array(dtype=wp.int64),
    out_vote: wp.array(dtype=wp.int64),
):
    """Each pair once, with the sum of its votes."""
    i = first + wp.tid()
    if head[i] == 0:
        return
    total = vote[i]
    at = i + 1
    while at < count and pair[at] == pair[i]:
        total += vote[at]
        at += 1
    out_pair[place[i] - 1] = pair[i]
    out_vote[place[i] - 1] = total


@wp.kernel
def best_pair_kernel(
    first: int,
    pair: wp.array(dtype=wp.int64),
    vote: wp.array(dtype=wp.int64),
    bits: wp.int32,
    out_best: wp.array(dtype=wp.int64),
):
    """The pair with the clearest vote of each cluster, at its root."""
    i = first + wp.tid()
    rank = edge_of(wp.float64(1.0) / wp.float64(wp.max(wp.abs(vote[i]), wp.int64(1))), wp.int64(i))
    low = pair[i] >> wp.int64(bits)
    lower_to(out_best, wp.int32(low), rank)
    lower_to(out_best, wp.int32(pair[i] ^ (low << wp.int64(bits))), rank)


@wp.kernel
def hook_pair_kernel(
    first: int,
    pair: wp.array(dtype=wp.int64),
    vote: wp.array(dtype=wp.int64),
    bits: wp.int32,
    best: wp.array(dtype=wp.int64),
    out_hook: wp.array(dtype=wp.int64),
):
    """The link of each root to the other root of its best pair; -1 for none."""
    r = first + wp.tid()
    out_hook[r] = wp.int64(-1)
    if best[r] == NONE:
        return
    at = wp.int32(best[r] & wp.int64(0x7FFFFFFF))
    low = pair[at] >> wp.int64(bits)
    other = low ^ (pair[at] ^ (low << wp.int64(bits))) ^ wp.int64(r)
    out_hook[r] = hook_to(r, other, best, wp.where(vote[at] < wp.int64(0), wp.int64(1), wp.int64(0)))


@wp.kernel
def rename_kernel(
    first: int,
    link: wp.array(dtype=wp.int64),
    bits: wp.int32,
    out_pair: wp.array(dtype=wp.int64),
    out_vote: wp.array(dtype=wp.int64),
):
    """Pairs and votes of the clusters' new roots; a bit above all pairs for what has become internal."""
    i = first + wp.tid()
    low = out_pair[i] >> wp.int64(bits)
    a = link[wp.int32(low)]
    b = link[wp.int32(out_pair[i] ^ (low << wp.int64(bits)))]
    if a >> wp.int64(1) == b >> wp.int64(1):
        out_pair[i] = wp.int64(1) << wp.int64(2 * bits)
        return
    out_pair[i] = pair_of(a, b, bits)
    if ((a ^ b) & wp.int64(1)) == wp.int64(1):
        out_vote[i] = -out_vote[i]


@wp.func_native("""
    int64_t bits;
    memcpy(&bits, &value, 8);
    return bits < 0 ? bits ^ 0x7fffffffffffffff : bits;
""")
def key_of(value: wp.float64) -> wp.int64:
    """Integer key that orders finite numbers from small to large."""
    ...


@wp.func_native("""
    const int64_t bits = key < 0 ? key ^ 0x7fffffffffffffff : key;
    double value;
    memcpy(&value, &bits, 8);
    return value;
""")
def value_of(key: wp.int64) -> wp.float64:
    """The number of a key."""
    ...


@wp.func
def height_of(i: wp.int32, root: wp.int32, points: wp.array(dtype=wp.vec3d)) -> wp.float64:
    """Height of a point above the root of its component."""
    return wp.dot(points[i] - points[root], UP)


@wp.kernel
def extent_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    normal: wp.array(dtype=wp.vec3d),
    reach: wp.array(dtype=wp.float64),
    neighbor: wp.array(dtype=wp.int32, ndim=2),
    link: wp.array(dtype=wp.int64),
    out_width: wp.array(dtype=wp.float64),
    out_lowest: wp.array(dtype=wp.int64),
    out_highest: wp.array(dtype=wp.int64),
    out_widest: wp.array(dtype=wp.int64),
):
    """Width of each point's share of the surface; keys of each component's least height and of the negative greatest
    height and width."""
    i = first + wp.tid()
    if is_zero(normal[i]):
        return
    # The least of the neighborhood: an outlier is far from its neighbors, but no large piece of surface.
    width = reach[i]
    for k in range(neighbor.shape[1]):
        j = neighbor[i, k]
        if j >= 0 and not is_zero(normal[j]):
            width = wp.min(width, reach[j])
    out_width[i] = width
    root = wp.int32(link[i] >> wp.int64(1))
    height = height_of(i, root, points)
    lower_to(out_lowest, root, key_of(height))
    lower_to(out_highest, root, key_of(-height))
    lower_to(out_widest, root, key_of(-width))


@wp.func
def add_caps(out_volume: wp.array(dtype=wp.int64, ndim=2), root: int, total: Caps, squares: Caps):
    """Add the sums of some points to those of their component, if there is one."""
    if root >= 0:
        for cap in range(CAPS):
            add_to(out_volume, root, cap, total[cap])
            add_to(out_volume, root, CAPS + cap, squares[cap])


@wp.kernel
def volume_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    normal: wp.array(dtype=wp.vec3d),
    width: wp.array(dtype=wp.float64),
    link: wp.array(dtype=wp.int64),
    lowest: wp.array(dtype=wp.int64),
    highest: wp.array(dtype=wp.int64),
    widest: wp.array(dtype=wp.int64),
    scale: wp.float64,
    out_volume: wp.array(dtype=wp.int64, ndim=2),
):
    """Volume of each cap, the sum of area x height x upward part of the normal, and the sum of the terms' squares.

    By the divergence theorem the volume of every cap is positive for closed surfaces with outward normals; for normals
    that point up it always is. Terms are shares of the largest possible one in units of 1 / scale: whole numbers, which
    add up alike in any order.
    """
    run = first + wp.tid()
    at = wp.int32(-1)
    total = Caps()
    squares = Caps()
    for i in range(run * VOLUME_RUN, wp.min((run + 1) * VOLUME_RUN, points.shape[0])):
        n = normal[i]
        if not is_zero(n):
            root = wp.int32(link[i] >> wp.int64(1))
            if root != at:
                add_caps(out_volume, at, total, squares)
                at = root
                total = Caps()
                squares = Caps()
            wide = -value_of(widest[root])
            below = -value_of(highest[root]) - height_of(i, root, points)
            depth = -value_of(highest[root]) - value_of(lowest[root]) + BELOW * wide
            area = (width[i] / wide) * (width[i] / wide) * wp.dot(n, UP)
            if (link[i] & wp.int64(1)) == wp.int64(1):
                area = -area
            for cap in range(CAPS):
                if below < depth:
                    share = area * (wp.float64(1.0) - below / depth)
                    total[cap] += wp.int64(share * scale)
                    squares[cap] += wp.int64(share * share * scale)
                depth = wp.float64(0.25) * depth
    add_caps(out_volume, at, total, squares)


@wp.func
def is_inward(volume: wp.array(dtype=wp.int64, ndim=2), root: wp.int32) -> wp.bool:
    """Whether the cap with the clearest volume, compared with what random signs of its terms would give, has a negative
    one."""
    inward = wp.bool(False)
    clearest = wp.float64(0.0)
    worth = wp.float64(1.0)
    for cap in range(CAPS):
        total = wp.float64(volume[root, cap])
        clear = worth * total * total / wp.float64(wp.max(volume[root, CAPS + cap], wp.int64(1)))
        if clear > clearest:
            clearest = clear
            inward = total < wp.float64(0.0)
        worth /= SMALLER
    return inward


@wp.kernel
def turn_kernel(
    first: int,
    order: wp.array(dtype=wp.int32),
    link: wp.array(dtype=wp.int64),
    volume: wp.array(dtype=wp.int64, ndim=2),
    out_normal: wp.array(dtype=wp.vec3d),
):
    """Flip the normals according to their parity to the root and the sign of the component's volume."""
    i = first + wp.tid()
    if is_inward(volume, wp.int32(link[i] >> wp.int64(1))) != ((link[i] & wp.int64(1)) == wp.int64(1)):
        out_normal[order[i]] = -out_normal[order[i]]
