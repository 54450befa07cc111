"""The k nearest points on the CPU: eight queries that are near each other share one walk over the tree.

All arithmetic is float64 and rounds in the order that is written, boxes as well as points. Rounding is monotone: the
squared distance of a box, computed as that of a point is, is never above that of a point in it. So no box that holds an
answer is passed over, and no tolerance is needed.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.cpp import cpp
from geokit.points.search.nearest_tree_kernels import LEAF, NONE, WIDTH, NearestQueries, NearestTree

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Blocks of queries of an item: the result of one group of eight is the first guess for the next.
BLOCKS = wp.constant(8)
# Open nodes of a walk: each of at most nine levels leaves seven behind.
STACK = 80
# Nodes that a shared walk may open without scanning a leaf for any query, and further ones for each leaf scanned.
# Queries that are far apart, or of which one reaches much farther than the others, are faster alone.
FREE_VISITS = 96
VISITS_PER_USE = 2
# Candidates that a query may have at a time, for lists of 1024.
CAPACITY = 1024 + 256 + 4 * int(LEAF)
# A first guess of the squared distance of the k-th, as a share of the farthest of the group before: a larger one finds
# more than k and has them sorted, a smaller one finds fewer and looks again.
GUESS = 1.1
# Allows for the roundings of a bound by the triangle inequality. A bound that is too small is only a wrong guess.
SLACK = 1.0 + 1e-12
# Factor for a guess that was too small, and how often it is applied before the search has no limit but the caller's.
WIDER = 4.0
GUESSES = 3


def _network(count: int) -> list[tuple[int, int]]:
    """Comparisons of Batcher's odd-even mergesort of a power of two of values."""
    pairs, p = [], 1
    while p < count:
        step = p
        while step >= 1:
            for j in range(step % p, count - step, 2 * step):
                for i in range(j, j + min(step, count - step - j)):
                    if i // (2 * p) == (i + step) // (2 * p):
                        pairs.append((i, i + step))
            step //= 2
        p *= 2
    return pairs


def _exchanges(pairs: list[tuple[int, int]]) -> str:
    return " ".join(f"exchange(s[{a}], m[{a}], s[{b}], m[{b}]);" for a, b in pairs)


# CUDA has a kernel of its own, nearest_cuda_kernels: its compiler knows no vectors of doubles.
@wp.func_native(
    cpp(
        "core/simd.inl",
        "points/search/nearest_lists_cpu.inl",
        "points/search/nearest_walk_cpu.inl",
        "points/search/nearest_cpu.inl",
        defines={
            "SORT_SIXTEEN": _exchanges(_network(16)),
            "MERGE_SIXTEEN": _exchanges([(i, i + step) for step in (8, 4, 2, 1) for i in range(16) if not i & step]),
        },
        LEAF=int(LEAF),
        WIDTH=int(WIDTH),
        NONE=int(NONE),
        BLOCKS=int(BLOCKS),
        STACK=STACK,
        FREE_VISITS=FREE_VISITS,
        VISITS_PER_USE=VISITS_PER_USE,
        CAPACITY=CAPACITY,
        GUESS=GUESS,
        SLACK=SLACK,
        WIDER=WIDER,
        GUESSES=GUESSES,
    )
)
def nearest_of_group(tree: NearestTree, queries: NearestQueries, group: wp.int32): ...


@wp.kernel
def nearest_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """The nearest points of BLOCKS blocks of queries."""
    nearest_of_group(tree, out_queries, first + wp.tid())
