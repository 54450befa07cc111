"""The k nearest points on a CPU: eight nearby queries share one traversal of the tree.

All arithmetic is float64 and rounds in the order written, for boxes as for points. Rounding is monotone: the squared
distance of a box, computed in the same way as that of a point, never exceeds that of a point inside. So no box that
holds a result is skipped, and no tolerance is needed.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.points.search.nearest_tree_kernels import LEAF, NONE, WIDTH, NearestQueries, NearestTree

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Blocks of queries of an item: the result of one group of eight is the initial bound of the next.
BLOCKS = wp.constant(8)
# Stack of open nodes: each of at most nine levels leaves seven behind.
STACK = 80
# Most candidates of a query at a time, for lists of 1024.
CAPACITY = 1024 + 256 + 4 * int(LEAF)


def _network(count: int) -> list[tuple[int, int]]:
    """Comparators of Batcher's odd-even mergesort for ``count`` values, a power of two."""
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


# CUDA has its own kernel, nearest_cuda_kernels, because its compiler has no vectors of doubles.
@wp.kernel
@cpp.native_item(
    "points/search/nearest_cpu.inl",
    "nearest_of_group",
    defines={
        "SORT_SIXTEEN": _exchanges(_network(16)),
        "MERGE_SIXTEEN": _exchanges([(i, i + step) for step in (8, 4, 2, 1) for i in range(16) if not i & step]),
    },
    LEAF=int(LEAF),
    WIDTH=int(WIDTH),
    NONE=int(NONE),
    BLOCKS=int(BLOCKS),
    STACK=STACK,
    CAPACITY=CAPACITY,
)
def nearest_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """Nearest points of BLOCKS blocks of queries."""
