"""The k nearest points on a GPU: one thread for each query, with its list in registers or as a heap in the result.

Adjacent threads handle adjacent queries and open mostly the same nodes. The comparisons, and so the results, are those
of nearest_cpu_kernels, bit for bit. The code is plain C++ and also runs on a CPU, which tests use.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.points.search.nearest_cpu_kernels import STACK
from geokit.points.search.nearest_tree_kernels import LEAF, NONE, WIDTH, NearestQueries, NearestTree

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Registers of a thread on a GPU; see docs/design/launches-and-memory.md.
REGISTERS = 96


def _nearest(length: int, function: str = "nearest_short"):
    """C++ of a thread's search with a list of a length."""
    constants = {"LEAF": int(LEAF), "WIDTH": int(WIDTH), "NONE": int(NONE), "STACK": STACK, "LENGTH": length}
    return cpp.native_item("points/search/nearest_cuda.inl", function, **constants)


@wp.kernel(cuda_max_registers=REGISTERS)
@_nearest(8)
def nearest_8_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """Lists of up to 8 points, in registers."""


@wp.kernel(cuda_max_registers=REGISTERS)
@_nearest(16)
def nearest_16_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """Lists of up to 16 points, in registers."""


@wp.kernel(cuda_max_registers=REGISTERS)
@_nearest(32)
def nearest_32_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """Lists of up to 32 points, in registers."""


# The length of a heap is that of the result.
@wp.kernel
@_nearest(1, "nearest_many")
def nearest_many_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """Lists of any length, as a heap in the result."""
