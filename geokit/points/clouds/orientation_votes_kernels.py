"""Votes between clusters of points: whether two clusters have the same sign, by the sum of all edges between them.

A pair is ``low << bits | high`` of the roots of two clusters; its vote is positive if they have the same sign. Votes
are whole numbers: their sums do not depend on the order.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.atomic_kernels import lower_to
from geokit.points.clouds.orientation_kernels import NONE, across, edge_of, weight_of

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# The vote of an edge that is sure. 2^30 edges of 2^24 are 2^54.
SURE = wp.constant(wp.float64(16777216.0))


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
    # Pairs are strictly ordered: two clusters may choose each other, but no longer cycles exist.
    if best[wp.int32(other)] == best[r] and wp.int64(r) < other:
        return
    opposite = wp.int64(0)
    if vote[at] < wp.int64(0):
        opposite = wp.int64(1)
    out_hook[r] = (other << wp.int64(1)) | opposite


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
