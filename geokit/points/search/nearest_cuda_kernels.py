"""The k nearest points on a GPU: short lists by one thread for each query, longer ones by a warp for several.

Adjacent queries open mostly the same nodes. The comparisons, and so the results, are those of nearest_cpu_kernels, bit
for bit. The code is plain C++ and also runs on a CPU, which tests use.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.points.search.nearest_tree_kernels import LEAF, NONE, WIDTH, NearestQueries, NearestTree

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Registers of a thread on a GPU; see docs/design/launches-and-memory.md.
REGISTERS, TEAM_REGISTERS = 96, 64


def _nearest(function: str, **constants: int):
    """C++ of a search; its tree's sizes are constants."""
    sizes = {"LEAF": int(LEAF), "WIDTH": int(WIDTH), "NONE": int(NONE), "LENGTH": 1, "ROOM": 256, "THREADS": 32}
    return cpp.native_item("points/search/nearest_cuda.inl", function, **(sizes | constants))


@wp.kernel(cuda_max_registers=REGISTERS)
@_nearest("nearest_alone", LENGTH=8)
def nearest_8_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """Lists of up to 8 points, in registers."""


# A team has room for ROOM candidates, in which ROOM - 32 neighbors find place, and for THREADS threads of a block.
@wp.kernel(cuda_max_registers=TEAM_REGISTERS)
@_nearest("nearest_together", ROOM=128)
def nearest_32_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """Lists of up to 32 points."""


@wp.kernel(cuda_max_registers=TEAM_REGISTERS)
@_nearest("nearest_together", ROOM=256)
def nearest_128_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """Lists of up to 128 points."""


@wp.kernel(cuda_max_registers=TEAM_REGISTERS)
@_nearest("nearest_together", ROOM=2048, THREADS=128)
def nearest_1024_kernel(first: int, tree: NearestTree, out_queries: NearestQueries):
    """Lists of up to 1024 points."""
