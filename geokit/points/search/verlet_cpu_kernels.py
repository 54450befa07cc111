"""Verlet lists on a CPU: the search of :mod:`geokit.points.search.radius_cpu_kernels`, without distances."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.points.search.cells_kernels import CellGrid
from geokit.points.search.neighbors_kernels import Queries
from geokit.points.search.radius_cpu_kernels import NUMBERS

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
@cpp.native_item("points/search/verlet_cpu.inl", "list_places", Queries, CellGrid, **NUMBERS)
def list_kernel(first: int):
    """Candidates of SHARE points each: their places, by ascending rank, which is ``grid.index``."""
