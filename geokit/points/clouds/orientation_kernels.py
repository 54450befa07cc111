"""Orientation of normals along a minimum spanning tree, by Boruvka's rounds on a union-find with parities.

A link is an ancestor and a parity, ``ancestor << 1 | parity``. The parity says whether a normal and that of its
ancestor have opposite signs along the tree. The tree itself is never stored. Both parts of a link change together, in
one 64-bit store.

An edge is a weight and a number, ``weight << 32 | number``, both of 32 bits: edges compare by weight, and no two are
equal. The number, ``row << bits | column``, is the edge's position in the table of neighbors. Each point has a row of
all its edges, the least first. Edges at the start of the row that have become internal to a component are skipped for
good.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.atomic_kernels import lower_to
from geokit.core.cpp import cpp

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Larger than every edge and every index.
NONE = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
# Smaller components are 0 up to rounding, and their signs carry no information.
NO_COMPONENT = wp.constant(wp.float64(1.0e-6))


@wp.func_native(cpp("points/clouds/flatten_link.inl"))
def flatten(link: wp.array(dtype=wp.int64), i: wp.int32):
    """Point the link of i directly to its root (path compression)."""
    ...


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
#if defined(__CUDA_ARCH__)
    return atomicAdd(values.data + at, 1);
#else
    return __atomic_fetch_add(values.data + at, 1, __ATOMIC_RELAXED);
#endif
""")
def add_one(values: wp.array(dtype=wp.int32), at: wp.int32) -> wp.int32:
    """Atomically add 1 to ``values[at]``, across CPU threads too, and return its old value."""
    ...


@wp.func_native(cpp("points/clouds/sort_edges.inl"))
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
    out_normal: wp.array(dtype=wp.vec3d),
    out_link: wp.array(dtype=wp.int64),
):
    """Normals in processing order; each point is its own root."""
    i = first + wp.tid()
    out_normal[i] = normal[order[i]]
    out_link[i] = wp.int64(i) << wp.int64(1)


@wp.func_native(cpp("points/clouds/owns_edge.inl"))
def is_mine(neighbor: wp.array(dtype=wp.int32, ndim=2), i: wp.int32, j: wp.int32) -> wp.bool:
    """Whether point i, which has the neighbor j, lists their edge; if both have each other, the lower index lists it.

    In C++, where the loop over a row is vectorized.
    """
    ...


@wp.kernel
def degree_kernel(
    first: int,
    normal: wp.array(dtype=wp.vec3d),
    neighbor: wp.array(dtype=wp.int32, ndim=2),
    out_degree: wp.array(dtype=wp.int32),
):
    """Number of edges of each point."""
    i = first + wp.tid()
    if not is_zero(normal[i]):
        for k in range(neighbor.shape[1]):
            j = neighbor[i, k]
            if is_mine(neighbor, i, j) and not is_zero(normal[j]):
                add_one(out_degree, i)
                add_one(out_degree, j)


@wp.kernel
def edge_kernel(
    first: int,
    normal: wp.array(dtype=wp.vec3d),
    neighbor: wp.array(dtype=wp.int32, ndim=2),
    bits: wp.int32,
    out_end: wp.array(dtype=wp.int32),
    out_edge: wp.array(dtype=wp.int64),
):
    """The edges of each point, unordered, from the position in ``out_end`` on, which is advanced to their end."""
    i = first + wp.tid()
    n = normal[i]
    if not is_zero(n):
        for k in range(neighbor.shape[1]):
            j = neighbor[i, k]
            if is_mine(neighbor, i, j) and not is_zero(normal[j]):
                weight = wp.max(wp.float64(1.0) - wp.abs(wp.dot(n, normal[j])), wp.float64(0.0))
                edge = edge_of(weight, (wp.int64(i) << wp.int64(bits)) | wp.int64(k))
                out_edge[add_one(out_end, i)] = edge
                out_edge[add_one(out_end, j)] = edge


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


@wp.kernel
def hook_kernel(
    first: int,
    normal: wp.array(dtype=wp.vec3d),
    neighbor: wp.array(dtype=wp.int32, ndim=2),
    bits: wp.int32,
    link: wp.array(dtype=wp.int64),
    best: wp.array(dtype=wp.int64),
    out_hook: wp.array(dtype=wp.int64),
    out_hooked: wp.array(dtype=wp.int32),
):
    """The link of each root across its best edge; -1 for none."""
    r = first + wp.tid()
    out_hook[r] = wp.int64(-1)
    if best[r] == NONE:
        return
    i = wp.int32(wp.uint32(best[r] & wp.int64(0xFFFFFFFF)) >> wp.uint32(bits))
    j = across(best[r], i, bits, neighbor)
    other = (link[i] ^ link[j]) >> wp.int64(1) ^ wp.int64(r)
    # Edges are strictly ordered: two components may choose each other, but no longer cycles exist.
    if best[wp.int32(other)] == best[r] and wp.int64(r) < other:
        return
    opposite = wp.int64(0)
    if wp.dot(normal[i], normal[j]) < wp.float64(0.0):
        opposite = wp.int64(1)
    out_hook[r] = (other << wp.int64(1)) | ((link[i] ^ link[j] ^ opposite) & wp.int64(1))
    out_hooked[0] = 1


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
def flatten_kernel(first: int, out_link: wp.array(dtype=wp.int64)):
    i = first + wp.tid()
    flatten(out_link, i)


@wp.func_native("""
    const double down = 0.0 - z;
    int64_t bits;
    memcpy(&bits, &down, 8);
    return bits < 0 ? bits ^ 0x7fffffffffffffff : bits;
""")
def depth_key(z: wp.float64) -> wp.int64:
    """Integer key that orders finite numbers from large to small."""
    ...


@wp.func
def points_down(n: wp.vec3d) -> wp.bool:
    """Whether z is negative; if z is 0 up to rounding, y decides, then x."""
    deciding = n[0]
    if wp.abs(n[1]) > NO_COMPONENT:
        deciding = n[1]
    if wp.abs(n[2]) > NO_COMPONENT:
        deciding = n[2]
    return deciding < wp.float64(0.0)


@wp.kernel
def highest_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    order: wp.array(dtype=wp.int32),
    link: wp.array(dtype=wp.int64),
    out_highest: wp.array(dtype=wp.int64),
):
    """Greatest z of each component, as a key."""
    i = first + wp.tid()
    lower_to(out_highest, wp.int32(link[i] >> wp.int64(1)), depth_key(points[order[i]][2]))


@wp.kernel
def seed_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    order: wp.array(dtype=wp.int32),
    link: wp.array(dtype=wp.int64),
    highest: wp.array(dtype=wp.int64),
    out_seed: wp.array(dtype=wp.int64),
):
    """Lowest index among the highest points of each component, ``index << 32 | i``."""
    i = first + wp.tid()
    root = wp.int32(link[i] >> wp.int64(1))
    if depth_key(points[order[i]][2]) == highest[root]:
        lower_to(out_seed, root, (wp.int64(order[i]) << wp.int64(32)) | wp.int64(i))


@wp.kernel
def turn_root_kernel(
    first: int,
    normal: wp.array(dtype=wp.vec3d),
    link: wp.array(dtype=wp.int64),
    seed: wp.array(dtype=wp.int64),
    out_turn: wp.array(dtype=wp.int64),
):
    """1 for roots whose normals must be flipped so that those of their seeds point up."""
    r = first + wp.tid()
    if seed[r] != NONE:
        s = wp.int32(seed[r] & wp.int64(0xFFFFFFFF))
        turn = link[s] & wp.int64(1)
        if points_down(normal[s]):
            turn = turn ^ wp.int64(1)
        out_turn[r] = turn


@wp.kernel
def turn_kernel(
    first: int,
    order: wp.array(dtype=wp.int32),
    link: wp.array(dtype=wp.int64),
    turn: wp.array(dtype=wp.int64),
    out_normal: wp.array(dtype=wp.vec3d),
):
    """Flip the normals according to their parity to the root and the flip of the root."""
    i = first + wp.tid()
    if ((turn[wp.int32(link[i] >> wp.int64(1))] ^ link[i]) & wp.int64(1)) == wp.int64(1):
        out_normal[order[i]] = -out_normal[order[i]]
